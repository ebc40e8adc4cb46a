"""`--workers`: the same answer from a cluster, one clear line where there is none."""

import importlib.util
import json
import sys
from pathlib import Path

import pytest

from tcbi_bringup import cli
from tcbi_sim.workers import Here, present
from tests.servo_bags import steps_bags


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return steps_bags(tmp_path_factory.mktemp("bags"))


@pytest.mark.parametrize("command", ["infer", "diagnose", "selftest"])
def test_workers_that_are_none_are_one_line_and_wrong_usage(command, bags, capsys) -> None:
    given = [] if command == "selftest" else [str(bags)]
    assert cli.main([command, *given, "--workers", "ray:rubbish"]) == 2
    said = capsys.readouterr().err
    assert "got 'ray:rubbish', allowed is ray (this machine)" in said and said.count("\n") == 1


def test_without_ray_one_line_says_how_to_install_it(bags, tmp_path, capsys, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    assert cli.main(["infer", str(bags), "--store", str(tmp_path), "--workers", "ray"]) == 1
    said = capsys.readouterr().err
    assert "requirements-ray.in" in said and said.count("\n") == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    "words",
    [
        ["infer", "--particles", "20", "--generations", "2"],
        ["diagnose", "--quick", "--effects", "load_friction,backlash"],
    ],
    ids=lambda words: words[0],
)
def test_a_cluster_gives_the_answer_of_this_process(words, bags, tmp_path, capsys) -> None:
    if importlib.util.find_spec("ray") is None:
        pytest.skip("ray is not installed; requirements-ray.in installs this optional extra")
    answers = []
    for name, workers in (("here", []), ("there", ["--workers", "ray"])):
        command = [words[0], str(bags), *words[1:], "--store", str(tmp_path / name), "--json", *workers]
        assert cli.main(command) == 0
        answers.append(json.loads(capsys.readouterr().out))
    for answer in answers:
        del answer["seconds"], answer["report"]
    assert answers[0] == answers[1] and present() == Here()
