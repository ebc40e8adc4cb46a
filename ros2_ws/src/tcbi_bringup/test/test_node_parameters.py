"""Parameters of nodes from the command line of `./tcbi up`: read by their type, refused by name before the start."""

from pathlib import Path

import pytest

from tcbi_bringup import cli
from tcbi_bringup.errors import WrongCallError
from tcbi_bringup.node_parameters import Setting, parameter_class
from tcbi_bringup.robot_graph import GraphOptions, graph_processes


def parameters(store: Path, *settings: tuple[str, str, str], **more) -> dict[str, dict]:
    options = GraphOptions(store=store, settings=tuple(Setting(*words) for words in settings), **more)
    return {process.key: dict(process.parameters) for process in graph_processes(options, store)}


def test_what_is_set_reaches_its_node_in_the_type_that_it_declares(tmp_path):
    given = parameters(
        tmp_path,
        ("inference_node", "posterior_moved", "1"),
        ("inference_node", "least_rollouts", "20"),
        ("inference_node", "retrain", "false"),
        ("recorder_node", "folder", "7"),
        ("sim_node", "seed", "3"),
        ("sim_node", "seed", "4"),
    )
    got = {name: given["inference_node"][name] for name in ("posterior_moved", "least_rollouts", "retrain")}
    assert got == {"posterior_moved": 1.0, "least_rollouts": 20, "retrain": False}
    assert isinstance(got["posterior_moved"], float), "a node takes no whole number for it"
    assert given["recorder_node"] == {"folder": "7"} and given["sim_node"]["seed"] == 4
    assert given["sim_node"]["store"] == given["inference_node"]["store"] == str(tmp_path), "all else as it was"
    assert given["policy_node"] == parameters(tmp_path)["policy_node"]


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        (("walk_node", "seed", "1"), "got node 'walk_node', allowed are those that start: sim_node, description_node"),
        (("inference_node", "posterior", "1"), "inference_node: unknown parameter 'posterior'; known are store, bags"),
        (("inference_node", "posterior_moved", "far"), "'posterior_moved': got 'far', allowed is float from 0.0"),
        (("inference_node", "posterior_moved", "-1"), "got '-1', allowed is float from 0.0"),
        (("inference_node", "posterior_moved", "Infinity"), "got 'Infinity', allowed is float"),
        (("inference_node", "least_rollouts", "8.5"), "got '8.5', allowed is int from 2 to 100000"),
        (("inference_node", "retrain", "1"), "got '1', allowed is bool"),
        (("sim_node", "mode", "fast"), "got 'fast', allowed is one of "),
    ],
)
def test_what_no_node_takes_is_refused_by_name_before_anything_starts(setting, words, tmp_path):
    with pytest.raises(WrongCallError) as refusal:
        GraphOptions(store=tmp_path, settings=(Setting(*setting),)).check()
    assert words in str(refusal.value) and str(refusal.value).startswith("--set: ")


def test_a_node_that_is_left_out_takes_nothing(tmp_path):
    with pytest.raises(WrongCallError, match="got node 'inference_node'"):
        parameters(tmp_path, ("inference_node", "seed", "1"), learning=False)


def test_every_node_of_every_graph_has_its_parameters_found(tmp_path):
    for robot in ("sim", "emulated", "port"):
        for process in graph_processes(GraphOptions(store=tmp_path, robot=robot), tmp_path):
            if process.ros:
                assert set(process.parameters) <= set(parameter_class(process).__dataclass_fields__), process.key


@pytest.mark.parametrize("text", ["inference_node", "inference_node.seed", "posterior_moved=1.0", "a.b.c=1"])
def test_a_setting_of_another_form_is_wrong_usage_in_one_line(text, capsys):
    assert cli.main(["up", "--set", text]) == 2
    said = capsys.readouterr().err.strip()
    assert f"--set: got {text!r}, allowed is NODE.PARAMETER=VALUE" in said and len(said.splitlines()) == 1
