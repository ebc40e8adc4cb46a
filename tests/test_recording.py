"""The recorder in a graph: rollouts on request, the same bits twice, a kill, a second recorder, a replay."""

import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosbags.rosbag2 import Reader
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Imu, JointState
from std_msgs.msg import String
from std_srvs.srv import SetBool
from trajectory_msgs.msg import JointTrajectory

from tcbi_bringup.launcher import Graph, NodeProcess
from tcbi_contract import messages, names
from tcbi_contract.names import JOINTS
from tcbi_infer.bags.reader import read_measurement
from tcbi_infer.bags.recovery import recover
from tcbi_infer.bags.scan import Scan
from tcbi_infer.bags.schemas import typestore
from tcbi_msgs.msg import RolloutEvent
from tcbi_msgs.srv import LoadPolicy
from tests.recording_cases import Collection, recorder, simulation

pytestmark = pytest.mark.graph


def contents(bag: Path) -> dict[str, np.ndarray]:
    """What a rollout measured and was told, without its name."""
    m = read_measurement(bag)
    assert m.notes == (), m.notes
    arrays = {n: v for n, v in vars(m).items() if isinstance(v, np.ndarray)}
    return {**arrays, "command_time": m.commands.time, "target": m.commands.target, "distance": np.array(m.distance)}


def test_rollouts_on_request_lose_nothing_and_repeat_bit_for_bit(start_graph, peer, tmp_path):
    start_graph(*simulation(tmp_path), recorder(tmp_path / "bags"))
    goal = {"task": "balance", "number": 2, "seed": 7}
    first = Collection(peer, **goal)
    status, result = first.result()
    assert status == GoalStatus.STATUS_SUCCEEDED and result.success, result.message
    assert len(result.bags) == 2 and {t.number for t in first.told} == {2}
    for bag in map(Path, result.bags):
        m = read_measurement(bag)
        np.testing.assert_allclose(np.diff(m.time), 0.02, atol=1e-9)
        assert len(m.time) == 401 and m.time[0] == 0 and len(m.commands.time) == 40
        assert m.scenario.task == "balance" and m.source == "sim" and m.policy_id.startswith("gait:tripod")
        assert np.isfinite(m.distance)
        with Reader(bag) as reader:
            assert {"/joint_states", "/imu/data", "/foot_contacts", "/joint_commands", "/rollout/event"} <= set(
                reader.topics
            )
    assert read_measurement(result.bags[0]).scenario.slope_roll != read_measurement(result.bags[1]).scenario.slope_roll
    status, again = Collection(peer, **goal).result()
    assert status == GoalStatus.STATUS_SUCCEEDED
    for one, other in zip(result.bags, again.bags, strict=True):
        a, b = contents(Path(one)), contents(Path(other))
        assert a.keys() == b.keys()
        assert [name for name in a if not np.array_equal(a[name], b[name])] == []


def test_a_collection_gives_back_the_policy_that_was_in_use(start_graph, peer, tmp_path):
    start_graph(*simulation(tmp_path), recorder(tmp_path / "bags"))
    in_use = peer.collect(names.POLICY_STATUS, String, messages.LATCHED_QOS)
    peer.wait_until(lambda: bool(in_use), "the policy in use")
    status, result = Collection(peer, task="balance", number=1, policy="gait:steps", duration_s=0.4).result()
    assert status == GoalStatus.STATUS_SUCCEEDED, result.message
    assert read_measurement(result.bags[0]).policy_id == "gait:steps"
    peer.wait_until(lambda: in_use[-1].data == "gait:tripod", "the policy that was in use before")
    assert [told.data for told in in_use] == ["gait:tripod", "gait:steps", "gait:tripod"]


def test_a_collection_leaves_in_use_what_has_been_put_in_place_of_its_policy_meanwhile(start_graph, peer, tmp_path):
    start_graph(*simulation(tmp_path, lockstep=False), recorder(tmp_path / "bags", lockstep=False))
    in_use = peer.collect(names.POLICY_STATUS, String, messages.LATCHED_QOS)
    for _ in range(3):  # a busy machine may hold up the policy, which ends a rollout
        collection = Collection(peer, task="balance", number=2, policy="gait:steps", duration_s=3.0)
        peer.wait_until(lambda collection=collection: bool(collection.told), "the rollout's begin")
        assert peer.call(names.LOAD_POLICY, LoadPolicy.Request(policy="gait:squat"), LoadPolicy).success
        status, result = collection.result()
        if status == GoalStatus.STATUS_SUCCEEDED:
            break
    assert status == GoalStatus.STATUS_SUCCEEDED, result.message
    assert [told.data for told in in_use][-2:] == ["gait:steps", "gait:squat"]
    said = [read_measurement(bag).policy_id for bag in result.bags]
    assert said == ["gait:steps then gait:squat", "gait:squat"], "what acted, whatever was asked for"


def test_a_better_policy_waits_for_the_end_of_a_collection_with_a_gait(start_graph, peer, tmp_path):
    start_graph(*simulation(tmp_path), recorder(tmp_path / "bags"))
    in_use = peer.collect(names.POLICY_STATUS, String, messages.LATCHED_QOS)
    peer.wait_until(lambda: bool(in_use), "the policy in use")
    collection = Collection(peer, task="balance", number=2, policy="gait:steps", duration_s=2.0)
    peer.wait_until(lambda: in_use[-1].data == "gait:steps", "the loan")
    better = LoadPolicy.Request(policy="balance", replaces="gait:tripod")
    answer = peer.call(names.LOAD_POLICY, better, LoadPolicy)
    assert answer.success and answer.policy_id == "gait:steps"
    status, result = collection.result()
    assert status == GoalStatus.STATUS_SUCCEEDED, result.message
    peer.wait_until(lambda: in_use[-1].data == answer.lender, "the better policy")
    assert [told.data for told in in_use] == ["gait:tripod", "gait:steps", answer.lender]
    assert {read_measurement(bag).policy_id for bag in result.bags} == {"gait:steps"}


def test_a_killed_recorder_loses_at_most_the_last_second(start_graph, peer, tmp_path):
    graph: Graph = start_graph(*simulation(tmp_path, lockstep=False), recorder(tmp_path / "bags", lockstep=False))
    seen = peer.collect(names.JOINT_STATES, JointState, messages.STREAM_QOS)
    begun = peer.collect(names.ROLLOUT_EVENT, RolloutEvent, messages.LATCHED_QOS)
    for _ in range(3):  # a busy machine may hold up the policy, which ends a rollout
        begun.clear()
        collection = Collection(peer, task="balance", number=1, seed=1, duration_s=60.0)
        peer.wait_until(lambda: bool(begun), "BEGIN")
        begin = messages.seconds(begun[0].header.stamp)
        ends = begin + 3.0
        peer.wait_until(lambda ends=ends: bool(seen) and messages.seconds(seen[-1].header.stamp) > ends, "3 s of it")
        if any((tmp_path / "bags").glob("*.recording")):
            break
    graph.send_signal("recorder_node", signal.SIGKILL)
    last = messages.seconds(seen[-1].header.stamp)
    assert graph.wait_for_exit("recorder_node", 10.0) == -signal.SIGKILL
    assert collection.sent.taken
    (left,) = (tmp_path / "bags").glob("*.recording")
    m = read_measurement(left)
    assert begin + m.time[-1] > last - 1.0
    copy = Path(shutil.copytree(left, tmp_path / "copy" / left.name))
    repaired = read_measurement(recover(copy).bag)
    assert len(repaired.time) == len(m.time)
    start_graph(
        NodeProcess("tcbi_infer", "recorder_node", name="next", parameters={"folder": str(tmp_path / "bags")}),
        wait=False,
    )
    final = tmp_path / "bags" / left.name.removesuffix(".recording")
    peer.wait_until((final / "metadata.yaml").is_file, "the next recorder's repair")
    assert len(read_measurement(final).time) == len(m.time)
    given: list[float] = []
    peer.node.create_subscription(
        JointTrajectory, names.JOINT_COMMANDS, lambda _: given.append(time.monotonic()), messages.STREAM_QOS
    )
    listening = time.monotonic()
    peer.wait_until(lambda: time.monotonic() - max([listening, *given]) > 1.0, "the policy to rest")


def test_a_second_recorder_on_the_same_folder_ends_with_one_line(start_graph, tmp_path):
    start_graph(recorder(tmp_path / "bags", lockstep=False))
    second = NodeProcess("tcbi_infer", "recorder_node", name="second", parameters={"folder": str(tmp_path / "bags")})
    graph = start_graph(second, wait=False)
    assert graph.wait_for_exit("second", 40.0) == 1
    assert "another recorder (process" in graph.tail("second", 1)


def test_cancelling_aborts_the_rollout_and_keeps_what_was_recorded(start_graph, peer, tmp_path):
    start_graph(*simulation(tmp_path, lockstep=False), recorder(tmp_path / "bags", lockstep=False))
    events = peer.collect(names.ROLLOUT_EVENT, RolloutEvent, messages.LATCHED_QOS)
    for _ in range(3):  # a busy machine may hold up the policy, which ends a rollout
        collection = Collection(peer, task="balance", number=3, seed=2)
        second = Collection(peer, task="balance", number=1)
        assert collection.sent.taken and not second.sent.taken
        begun = lambda one=collection: any(t.remaining_s < 6.5 for t in one.told)  # noqa: E731
        peer.wait_until(lambda one=collection, begun=begun: begun() or one.ended(), "the first seconds")
        if begun():
            break
    peer.result(collection.sent.handle.cancel_goal_async(), "the answer to the cancelling")
    status, result = collection.result()
    assert status == GoalStatus.STATUS_CANCELED and not result.success and list(result.bags) == []
    peer.wait_until(lambda: events[-1].kind == RolloutEvent.ABORT, "ABORT")
    m = read_measurement(tmp_path / "bags" / events[-1].rollout_id)
    assert len(m.time) > 50 and any("aborted (cancelled)" in note for note in m.notes)
    assert m.scenario.duration < 8.0


def test_a_policy_that_stops_in_a_rollout_ends_it_as_aborted(start_graph, peer, tmp_path):
    start_graph(*simulation(tmp_path, lockstep=False), recorder(tmp_path / "bags", lockstep=False))
    told = peer.collect(names.JOINT_COMMANDS, JointTrajectory, messages.STREAM_QOS)
    collection = Collection(peer, task="balance", number=2, seed=1)
    # on a busy machine the policy may stop by itself, for want of fresh joint angles
    peer.wait_until(lambda: len(told) > 3 or collection.ended(), "commands")
    peer.call(names.ENABLE_POLICY, SetBool.Request(data=False), SetBool)
    status, result = collection.result()
    assert status == GoalStatus.STATUS_ABORTED and "has sent no joint_commands" in result.message
    (bag,) = (tmp_path / "bags").glob("balance-*")
    m = read_measurement(bag)
    assert m.scenario.duration < 7 and any("aborted" in note for note in m.notes)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_collect_that_is_ended_by_a_signal_closes_its_rollout_and_asks_for_no_more(
    start_graph, peer, tmp_path, domain, number
):
    start_graph(*simulation(tmp_path, lockstep=False), recorder(tmp_path / "bags", lockstep=False))
    events = peer.collect(names.ROLLOUT_EVENT, RolloutEvent, messages.LATCHED_QOS)
    told = peer.collect(names.JOINT_COMMANDS, JointTrajectory, messages.STREAM_QOS)
    command = [sys.executable, "-m", "tcbi_bringup.cli", "collect", "--task", "balance", "--n", "3"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as collect:
        peer.wait_until(lambda: len(told) > 3, "commands")
        collect.send_signal(number)
        peer.wait_until(lambda: events[-1].kind == RolloutEvent.ABORT, "ABORT")
        _, error = collect.communicate(timeout=60)
    assert collect.returncode == (1 if number == signal.SIGINT else 128 + signal.SIGTERM), error
    assert "Traceback" not in error
    (bag,) = (tmp_path / "bags").glob("balance-*")
    assert any("aborted (cancelled)" in note for note in read_measurement(bag).notes)


def test_a_missing_node_is_named(start_graph, peer, tmp_path):
    start_graph(recorder(tmp_path / "bags", lockstep=False, service_timeout_s=0.5))
    status, result = Collection(peer, task="balance", number=1).result()
    assert status == GoalStatus.STATUS_ABORTED
    assert result.message == "nobody offers policy/enable after 0.5 s; start policy_node"
    status, result = Collection(peer, task="balance", number=1, policy="none").result()
    assert result.message == "nobody offers reset_episode after 0.5 s; start sim_node or driver_node"
    status, result = Collection(peer, task="dance", number=0, slope_roll=[1.0]).result()
    assert "task: got 'dance'" in result.message and "number: got 0" in result.message


def test_a_sensor_whose_profile_does_not_fit_is_said(start_graph, peer, tmp_path):
    graph = start_graph(recorder(tmp_path))
    careless = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
    publisher = peer.node.create_publisher(Imu, names.IMU, careless)

    def said() -> bool:
        publisher.publish(Imu())
        return "incompatible QoS" in graph.tail("recorder_node")

    peer.wait_until(said, "the warning of the recorder")


def test_no_room_on_the_disk_aborts_with_one_line_and_shows_in_diagnostics(start_graph, peer, tmp_path):
    start_graph(*simulation(tmp_path), recorder(tmp_path / "bags", min_free_mb=1e9))
    health = peer.collect(names.DIAGNOSTICS, DiagnosticArray, messages.STREAM_QOS)
    status, result = Collection(peer, task="balance", number=1).result()
    assert status == GoalStatus.STATUS_ABORTED and "make room on the disk" in result.message

    def shown() -> bool:
        states = [s for array in health for s in array.status if s.name.startswith("recorder_node")]
        return any(s.level == DiagnosticStatus.ERROR and "make room" in s.message for s in states)

    peer.wait_until(shown, "the error in diagnostics")


def test_a_disk_that_fills_up_in_a_rollout_costs_its_end_alone(start_graph, peer, tmp_path):
    graph = start_graph(*simulation(tmp_path), recorder(tmp_path / "bags"))
    status, before = Collection(peer, task="balance", number=1, seed=1).result()
    assert status == GoalStatus.STATUS_SUCCEEDED
    events = peer.collect(names.ROLLOUT_EVENT, RolloutEvent, messages.LATCHED_QOS)
    health = peer.collect(names.DIAGNOSTICS, DiagnosticArray, messages.STREAM_QOS)
    pid = next(s.pid for s in graph.status() if s.name == "recorder_node")
    unlimited = resource.prlimit(pid, resource.RLIMIT_FSIZE)
    resource.prlimit(pid, resource.RLIMIT_FSIZE, (100_000, unlimited[1]))  # a disk with this much room
    status, result = Collection(peer, task="balance", number=2, seed=2).result()
    assert status == GoalStatus.STATUS_ABORTED and "cannot be written any more (File too large)" in result.message
    peer.wait_until(lambda: bool(events) and events[-1].kind == RolloutEvent.ABORT, "ABORT")

    def levels() -> list[bytes]:
        return [s.level for array in health for s in array.status if s.name.startswith("recorder_node")]

    peer.wait_until(lambda: DiagnosticStatus.ERROR in levels(), "the fault in diagnostics")
    part = read_measurement(tmp_path / "bags" / events[-1].rollout_id)
    assert 0.5 < part.time[-1] < 8.0
    assert len(read_measurement(before.bags[0]).time) == 401
    resource.prlimit(pid, resource.RLIMIT_FSIZE, unlimited)  # somebody made room
    status, result = Collection(peer, task="balance", number=1, seed=3).result()
    assert status == GoalStatus.STATUS_SUCCEEDED, result.message


def test_another_programs_events_are_recorded_too(start_graph, peer, tmp_path):
    start_graph(recorder(tmp_path / "bags", lockstep=False))
    joints = peer.publisher(names.JOINT_STATES, JointState, messages.STREAM_QOS)
    events = peer.publisher(names.ROLLOUT_EVENT, RolloutEvent, messages.LATCHED_QOS)
    event = RolloutEvent(rollout_id="before", kind=RolloutEvent.BEGIN, task="forward", source="lab")
    event.header.stamp = peer.node.get_clock().now().to_msg()
    events.publish(event)  # publishers are discovered in their order: who hears this one hears joints, too
    peer.wait_until((tmp_path / "bags" / "before.recording").is_dir, "the recorder's ear")
    event.kind = RolloutEvent.ABORT
    events.publish(event)
    peer.wait_until(lambda: not (tmp_path / "bags" / "before.recording").exists(), "the end of what was before")
    begin = peer.node.get_clock().now().nanoseconds
    event = RolloutEvent(rollout_id="by_hand", kind=RolloutEvent.BEGIN, task="forward", source="lab")
    event.header.stamp = messages.to_stamp(begin)
    joints.publish(messages.joint_state(messages.to_stamp(begin), [0.5] * 18))
    events.publish(event)
    for k in range(1, 51):
        for _ in range(1 + (k == 25)):  # once as a simulation repeats its present
            joints.publish(messages.joint_state(messages.to_stamp(begin + k * 20_000_000), [0.01 * k] * 18))
        peer.executor.spin_once(timeout_sec=0.005)
    event.kind, event.distance = RolloutEvent.END, 0.75
    event.header.stamp = messages.to_stamp(begin + 1_000_000_000)
    peer.wait_until((tmp_path / "bags" / "by_hand.recording").is_dir, "the recording")
    events.publish(event)
    peer.wait_until((tmp_path / "bags" / "by_hand" / "metadata.yaml").is_file, "the bag")
    m = read_measurement(tmp_path / "bags" / "by_hand")
    (file,) = (tmp_path / "bags" / "by_hand").glob("*.mcap")
    assert sum(message.channel.topic == "/joint_states" for message in Scan(file).messages()) == 51
    assert len(m.time) == 51 and m.distance == 0.75 and m.joint_position[0, 0] == 0.5 and m.source == "lab"


@pytest.mark.parametrize("rate", [1.0, 5.0, 500.0])
def test_a_replay_gives_back_the_same_bytes_and_the_recordings_clock(start_graph, peer, tmp_path, rate):
    bag = made_bag(tmp_path)
    heard: list[bytes] = []
    peer.node.create_subscription(JointState, names.JOINT_STATES, heard.append, 500, raw=True)
    clock = peer.collect(names.CLOCK, Clock, messages.STREAM_QOS)
    values = {"bag": str(bag), "rate": rate, "wait_for": 1}
    graph = start_graph(NodeProcess("tcbi_infer", "replay_node", parameters=values), wait=False)
    assert finished(peer, graph, "replay_node") == 0
    original = [m.data for m in Scan(bag / "made_0.mcap").messages() if m.channel.topic == "/joint_states"]
    assert heard == original
    times = [messages.seconds(c.clock) for c in clock]
    assert times == sorted(set(times)) and times[-1] == pytest.approx(3.0) and len(times) > 50


def made_bag(folder: Path) -> Path:
    from tcbi_infer.bags.measurement_writer import write_measurement
    from tcbi_sim.measurement import Commands, Measurement, Scenario

    time = np.arange(101) * 0.02
    position = np.sin(time)[:, None] * np.ones(18)
    commands = Commands(np.empty(0), np.empty((0, 18)))
    made = Measurement("made", "hexapod", Scenario("balance", 2.0), "", "sim", commands, JOINTS, (), time, position)
    return write_measurement(folder, made)


def finished(peer, graph: Graph, name: str) -> int:
    def ended() -> bool:
        return next(s for s in graph.status() if s.name == name).exit_code is not None

    peer.wait_until(ended, f"the end of {name}")
    return graph.wait_for_exit(name, 5.0)


def test_the_contracts_types_have_the_hashes_that_ros_gives_them(peer, domain):
    publisher = peer.publisher(names.ROLLOUT_EVENT, RolloutEvent, messages.LATCHED_QOS, subscribers=0)
    peer.wait_until(lambda: bool(peer.node.get_publishers_info_by_topic(names.ROLLOUT_EVENT)), "the publisher")
    info = peer.node.get_publishers_info_by_topic(names.ROLLOUT_EVENT)[0]
    told = getattr(info, "topic_type_hash", None)
    if told is None:
        pytest.skip("this rclpy does not tell the hashes of types")
    assert str(told) == typestore().hash_rihs01("tcbi_msgs/msg/RolloutEvent")
    assert publisher.topic_name
