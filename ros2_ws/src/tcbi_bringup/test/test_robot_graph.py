"""The composition of a graph agrees with the nodes it starts."""

import dataclasses
import importlib
from importlib import resources
from importlib.metadata import entry_points
from pathlib import Path

import pytest

from hexapod_driver.errors import CalibrationError
from tcbi_bringup.errors import LaunchError, WrongCallError
from tcbi_bringup.launcher import Graph, NodeProcess
from tcbi_bringup.robot_graph import GraphOptions, companion_processes, robot_processes, start_graph
from tcbi_policy.artefact import find_policy, save_policy
from tcbi_policy.errors import PolicyDamaged, PolicyMisfit, PolicyNotFound
from tcbi_policy.layout import HEXAPOD
from tcbi_sim.errors import UnknownNameError

EVERYTHING = {"policy": "gait:tripod", "task": "forward", "namespace": "left"}


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    """The store of `options`, which a check makes, is a folder of the test's own."""
    monkeypatch.chdir(tmp_path)


def options(**more) -> GraphOptions:
    return GraphOptions(store=Path("store"), **more)


def every_process() -> list[NodeProcess]:
    robots = [options(robot="sim", lockstep=True, **EVERYTHING), options(robot="emulated"), options(robot="port")]
    found = {p.executable: p for o in robots for p in [*robot_processes(o, Path("run")), *companion_processes(o)]}
    return list(found.values())


def declared_parameters(process: NodeProcess) -> dict[str, dataclasses.Field]:
    """Fields of the parameter dataclass in the module that the executable starts."""
    entry = next(e for e in entry_points(group="console_scripts", name=process.executable))
    module = importlib.import_module(entry.module)
    own = [c for c in vars(module).values() if isinstance(c, type) and dataclasses.is_dataclass(c)]
    return {f.name: f for c in own for f in dataclasses.fields(c) if "text" in f.metadata}


@pytest.mark.parametrize("process", [p for p in every_process() if p.ros], ids=lambda p: p.executable)
def test_every_parameter_given_to_a_node_is_one_that_it_declares(process):
    unknown = set(process.parameters) - set(declared_parameters(process)) - {"use_sim_time"}
    assert not unknown, f"{process.executable} declares {sorted(declared_parameters(process))}"


def test_only_a_lockstep_graph_runs_on_simulated_time():
    for lockstep in (True, False):
        for process in companion_processes(options(lockstep=lockstep)):
            assert process.parameters.get("use_sim_time", False) is lockstep
    for process in robot_processes(options(lockstep=True), Path("run")):
        assert "use_sim_time" not in process.parameters  # the sim node is the clock


def test_without_a_robot_all_the_rest_starts_on_simulated_time(tmp_path):
    alone = GraphOptions(store=tmp_path, robot="none")
    alone.check()
    assert robot_processes(alone, Path("run")) == []
    rest = companion_processes(alone)
    assert [p.executable for p in rest] == [p.executable for p in companion_processes(options())]
    assert all(p.parameters["use_sim_time"] is True for p in rest)


@pytest.mark.parametrize(
    ("option", "more"),
    [
        ("--lockstep", {"lockstep": True}),
        ("--hidden", {"hidden": "payload"}),
        ("--strength", {"strength": "weak"}),
        ("--task", {"task": "forward"}),
        ("--seed", {"seed": 1}),
        ("--baud-rate", {"baud_rate": 115_200}),
    ],
)
def test_what_is_said_of_a_robot_is_refused_where_there_is_none(option, more):
    with pytest.raises(WrongCallError, match=f"^{option}: got --robot none, allowed is "):
        options(robot="none", **more).check()


def test_lockstep_needs_the_simulation():
    with pytest.raises(WrongCallError, match="--lockstep: got --robot emulated, allowed is sim"):
        options(robot="emulated", lockstep=True).check()


def test_a_real_robots_driver_gets_its_second_port_and_its_calibration(tmp_path):
    for name in ("bus", "board"):
        (tmp_path / name).touch()
    shipped = Path(str(resources.files("hexapod_driver") / "calibration.toml"))
    mine = tmp_path / "mine.toml"
    mine.write_text(shipped.read_text())
    wanted = options(robot=str(tmp_path / "bus"), sensor_port=str(tmp_path / "board"), calibration=str(mine))
    wanted.check()
    (driver,) = robot_processes(dataclasses.replace(wanted, baud_rate=115_200), Path("run"))
    assert driver.parameters["sensor_port"] == str(tmp_path / "board")
    assert driver.parameters["baud_rate"] == 115_200 and "sensor_baud_rate" not in driver.parameters
    assert driver.parameters["calibration"] == str(mine)


def test_a_calibration_that_cannot_be_read_is_refused_before_anything_starts(tmp_path):
    (tmp_path / "bus").touch()
    (tmp_path / "bad.toml").write_text("servos = ")
    with pytest.raises(CalibrationError, match="not valid TOML"):
        options(robot=str(tmp_path / "bus"), calibration=str(tmp_path / "bad.toml")).check()
    with pytest.raises(LaunchError, match=r"--sensor-port: got '.*gone', allowed is a serial port that exists"):
        options(robot=str(tmp_path / "bus"), sensor_port=str(tmp_path / "gone")).check()


@pytest.mark.parametrize("robot", ["sim", "emulated", "none"])
def test_only_a_real_robot_has_a_calibration_and_a_second_port(robot):
    with pytest.raises(WrongCallError, match=f"--calibration: got --robot {robot}"):
        options(robot=robot, calibration="mine.toml").check()
    with pytest.raises(WrongCallError, match=f"--sensor-baud-rate: got --robot {robot}"):
        options(robot=robot, sensor_baud_rate=9600).check()
    with pytest.raises(WrongCallError, match=f"--sensor-port: got --robot {robot}"):
        options(robot=robot, sensor_port="/dev/ttyUSB1").check()


def test_a_port_that_is_not_there_is_named_with_what_is(tmp_path):
    with pytest.raises(
        LaunchError, match=r"got '.*nothing', allowed is sim, emulated, none, or a serial port.*present"
    ):
        options(robot=str(tmp_path / "nothing")).check()


def test_an_emulated_robot_and_its_driver_share_a_port():
    emulated, driver, experimenter = robot_processes(options(robot="emulated", namespace="left"), Path("run"))
    assert str(driver.parameters["port"]) in emulated.arguments
    assert str(experimenter.parameters["socket"]) in emulated.arguments
    assert driver.namespace == experimenter.namespace == "left"


def test_what_is_hidden_in_an_emulated_robot_is_told_to_it_alone():
    emulated, driver, _ = robot_processes(options(robot="emulated", hidden="payload", strength="weak"), Path("run"))
    chosen = emulated.arguments[emulated.arguments.index("--strength") :]
    assert chosen == ("--strength", "weak", "--hidden", "payload") and "payload" not in str(driver)
    assert "--hidden" not in robot_processes(options(robot="emulated"), Path("run"))[0].arguments
    assert "strong" in robot_processes(options(robot="emulated"), Path("run"))[0].arguments
    with pytest.raises(WrongCallError, match="--hidden: got --robot sim, allowed is emulated"):
        options(hidden="payload").check()
    with pytest.raises(WrongCallError, match="--strength: got --robot sim, allowed is emulated"):
        options(strength="weak").check()


def test_a_recorder_that_is_told_where_to_record_leaves_the_store_s_folder_to_others(tmp_path):
    def folder(**more) -> str:
        recorder = next(p for p in companion_processes(options(**more)) if p.executable == "recorder_node")
        return str(recorder.parameters["folder"])

    assert folder(recordings=tmp_path) == str(tmp_path)
    assert folder() == str(Path("store") / "rollouts")
    assert folder(namespace="left") == str(Path("store") / "rollouts" / "left"), "each recorder has its own"


def test_the_inference_node_looks_where_the_recorder_records_and_at_the_model_that_was_named(tmp_path):
    nodes = {p.executable: p for p in companion_processes(options(recordings=tmp_path, model="hexapod-v3"))}
    assert nodes["inference_node"].parameters["bags"] == nodes["recorder_node"].parameters["folder"] == str(tmp_path)
    assert nodes["inference_node"].parameters["model"] == "hexapod-v3"


@pytest.mark.parametrize("robot", ["sim", "emulated"])
def test_a_policy_that_does_not_exist_is_refused_before_anything_starts(robot, tmp_path):
    with pytest.raises(PolicyNotFound, match="'nonsense' does not exist; there are"):
        GraphOptions(store=tmp_path, robot=robot, policy="nonsense").check()
    GraphOptions(store=tmp_path, robot=robot, policy="gait:tripod").check()


def test_a_task_that_does_not_exist_is_refused_before_anything_starts(tmp_path):
    with pytest.raises(UnknownNameError, match="unknown task 'walk'; known: balance, forward"):
        GraphOptions(store=tmp_path, task="walk").check()
    GraphOptions(store=tmp_path, task="forward").check()


def test_a_policy_of_another_robot_is_refused_by_the_name_of_what_differs(tmp_path):
    stem = tmp_path / "policies" / "other"
    layout = dataclasses.replace(HEXAPOD, action=("lf_hip", *HEXAPOD.action[1:]), rate_hz=10.0)
    shipped = find_policy("balance")
    save_policy(stem, shipped.mlp, dataclasses.replace(shipped.card, layout=layout))
    with pytest.raises(PolicyMisfit, match=r"needs lf_hip.*lacks lf_coxa.*10 Hz, the robot's is 5 Hz"):
        GraphOptions(store=tmp_path, policy="other").check()


def test_a_policy_whose_card_is_none_says_which_entry_is_missing(tmp_path):
    stem = tmp_path / "policies" / "bare"
    shipped = find_policy("balance")
    save_policy(stem, shipped.mlp, shipped.card)
    stem.with_suffix(".json").write_text("{}")
    with pytest.raises(PolicyDamaged, match="its card lacks 'format'"):
        GraphOptions(store=tmp_path, policy="bare").check()


def test_an_emulated_robot_that_ends_at_once_is_told_before_anybody_waits_for_its_port(tmp_path):
    with Graph(log_dir=tmp_path) as graph, pytest.raises(LaunchError, match="emulated_robot ended with"):
        start_graph(graph, options(robot="emulated", hidden="nonsense"), tmp_path)


def test_a_model_that_there_is_not_is_refused_before_anything_starts(tmp_path):
    GraphOptions(store=tmp_path, model="hexapod-v0").check()
    with pytest.raises(UnknownNameError, match=r"unknown model version 'hexapod-v99'.*known: hexapod-v0"):
        GraphOptions(store=tmp_path, model="hexapod-v99").check()


@pytest.mark.parametrize("folder", ["/proc/rollouts", "file/rollouts"])
def test_a_folder_that_cannot_hold_recordings_is_refused_before_anything_starts(folder, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(LaunchError, match=r"cannot be used for recordings .*choose another folder"):
        GraphOptions(store=tmp_path, recordings=tmp_path / folder).check()
