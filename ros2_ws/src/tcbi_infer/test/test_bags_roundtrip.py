"""A measurement written as a bag and read back is the same, and other readers agree with what is in it."""

import dataclasses
import re
import subprocess
from pathlib import Path

import numpy as np
import pytest
import yaml
from bag_cases import bench, differences, rollout
from rosbags.rosbag2 import Reader

from tcbi_contract import names
from tcbi_infer.bags import schemas
from tcbi_infer.bags.measurement_writer import write_measurement
from tcbi_infer.bags.reader import read_measurement, read_measurements
from tcbi_infer.bags.scan import Scan
from tcbi_infer.errors import BagError
from tcbi_sim.measurement import Commands

# installations whose `ros2 bag` reads MCAP files
ROSBAG2 = [plugin.parents[1] for plugin in sorted(Path("/opt/ros").glob("*/share/rosbag2_storage_mcap"))]
ROSBAG2 = [prefix for prefix in ROSBAG2 if (prefix / "share" / "ros2bag").is_dir()]


@pytest.mark.parametrize("case", [rollout(), bench()], ids=["hexapod", "bench"])
def test_every_bit_survives_a_bag(tmp_path, case):
    back = read_measurement(write_measurement(tmp_path, case))
    assert differences(case, back) == []
    assert back.notes == ()


@pytest.mark.parametrize("absent", ["attitude", "angular_velocity", "linear_acceleration", "contact", "position"])
def test_what_was_not_measured_stays_absent(tmp_path, absent):
    case = dataclasses.replace(rollout(), **{absent: None})
    back = read_measurement(write_measurement(tmp_path, case))
    assert differences(case, back) == []


def test_torque_commands_travel_as_effort(tmp_path):
    case = dataclasses.replace(bench(), commands=Commands(np.array([0.0, 0.1]), np.array([[0.2], [-0.1]]), 0.0))
    bag = write_measurement(tmp_path, case, torque_commands=True)
    assert differences(case, read_measurement(bag)) == []
    first = next(m for m in Scan(bag / "kp100_0.mcap").messages() if m.channel.topic == "/joint_commands")
    point = schemas.decode(first.data, first.channel.message_type, "ros2msg", first.channel.definition).points[0]
    assert len(point.positions) == 0 and point.effort.tolist() == [0.2]


def test_an_independent_reader_finds_every_message_with_its_type_hash_and_qos(tmp_path):
    case = rollout()
    bag = write_measurement(tmp_path, case)
    with Reader(bag) as reader:
        counts = {c.topic: c.msgcount for c in reader.connections}
        assert counts == {
            "/rollout/event": 2,
            "/joint_commands": len(case.commands.time),
            "/joint_states": len(case.time),
            "/imu/data": len(case.time),
            "/foot_contacts": len(case.time),
            "/tracker/pose": len(case.time),
        }
        assert reader.duration == round(case.time[-1] * 1e9) + 1
        store = schemas.typestore()
        positions = []
        for connection, _, data in reader.messages():
            assert connection.digest == store.hash_rihs01(connection.msgtype)
            assert connection.ext.offered_qos_profiles[0].depth == (1 if connection.topic == "/rollout/event" else 50)
            if connection.topic == "/joint_states":
                positions.append(store.deserialize_cdr(data, connection.msgtype).position)
    assert np.array_equal(positions, case.joint_position)


@pytest.mark.skipif(not ROSBAG2, reason="no ROS with ros2bag and rosbag2_storage_mcap in /opt/ros: not read by rosbag2")
def test_ros2_bag_info_finds_every_message(tmp_path):
    case = rollout()
    bag = write_measurement(tmp_path, case)
    command = f". {ROSBAG2[-1] / 'setup.bash'} && exec ros2 bag info {bag}"
    plain = {"HOME": str(tmp_path), "PATH": "/usr/bin:/bin", "LANG": "C.UTF-8"}  # nothing of the environment of ./tcbi
    said = subprocess.run(["bash", "-c", command], env=plain, capture_output=True, text=True, timeout=60, check=False)
    assert said.returncode == 0, said.stderr
    counts = dict(re.findall(r"Topic: (\S+) \| Type: \S+ \| Count: (\d+)", said.stdout))
    with Reader(bag) as reader:
        assert counts == {c.topic: str(c.msgcount) for c in reader.connections}


def test_the_layout_is_the_contracts(tmp_path):
    bag = write_measurement(tmp_path, rollout())
    assert sorted(p.name for p in bag.iterdir()) == ["metadata.yaml", "walk_1_0.mcap"]
    information = yaml.safe_load((bag / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert information["version"] == 9 and information["storage_identifier"] == "mcap"
    assert information["relative_file_paths"] == ["walk_1_0.mcap"]
    scan = Scan(bag / "walk_1_0.mcap")
    channels = {m.channel for m in scan.messages()}
    assert scan.profile == "ros2" and scan.finished and not scan.damage
    assert {c.message_encoding for c in channels} == {"cdr"} and {c.schema_encoding for c in channels} == {"ros2msg"}
    event = next(c for c in channels if c.topic == "/rollout/event")
    assert all(
        f"MSG: {name}" in event.definition for name in ("tcbi_msgs/Block", "std_msgs/Header", "geometry_msgs/Point")
    )
    assert b"zstd" in (bag / "walk_1_0.mcap").read_bytes()


def test_own_message_texts_are_those_of_the_interface_package():
    folder = Path(__file__).parents[2] / "tcbi_msgs" / "msg"
    if not folder.is_dir():
        pytest.skip("the interface package is not beside this one")
    for message_type, text in schemas.OWN_TYPES.items():
        source = (folder / f"{message_type.split('/')[-1]}.msg").read_text()
        fields = [" ".join(line.split("#")[0].split()) for line in source.splitlines()]
        assert [f for f in fields if f] == text.split("\n")[:-1]


def test_a_namespace_changes_nothing(tmp_path):
    case = rollout()
    bag = write_measurement(tmp_path, case, namespace="/lab/robot_2/")
    with Reader(bag) as reader:
        assert "/lab/robot_2/imu/data" in reader.topics
    assert differences(case, read_measurement(bag)) == []


def test_a_bare_file_reads_like_its_bag(tmp_path):
    case = rollout()
    bag = write_measurement(tmp_path, case)
    bare = (bag / "walk_1_0.mcap").rename(tmp_path / "elsewhere.mcap")
    assert differences(case, read_measurement(bare)) == []


def test_a_folder_stands_for_the_bags_in_it_and_a_rollout_given_twice_is_refused(tmp_path):
    for i in (10, 2, 1):
        write_measurement(tmp_path, rollout(f"walk_{i}", samples=20, seed=i))
    assert [m.rollout_id for m in read_measurements([tmp_path])] == ["walk_1", "walk_2", "walk_10"]
    with pytest.raises(BagError, match=r"is also in .*count twice"):
        read_measurements([tmp_path, tmp_path / "walk_2" / "walk_2_0.mcap"])


def test_a_bag_is_never_overwritten(tmp_path):
    write_measurement(tmp_path, rollout())
    with pytest.raises(BagError, match="walk_1 exists already"):
        write_measurement(tmp_path, rollout())


def test_every_topic_of_the_contract_has_a_definition_and_a_hash():
    for message_type in schemas.MESSAGES.values():
        assert schemas.type_hash(message_type).startswith("RIHS01_")
        assert "std_msgs/Header" in schemas.definition(message_type)
    assert names.JOINT_STATES in schemas.MESSAGES
