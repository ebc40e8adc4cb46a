"""`./tcbi infer`, through the command line: what it prints for scripts, and advice on what to record."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tcbi_bringup import cli
from tcbi_bringup.commands import infer
from tcbi_infer.bags.measurement_writer import write_measurement
from tcbi_sim.engine import simulate
from tcbi_sim.measurement import Commands, Scenario
from tcbi_sim.model import base_model


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Four recordings of a servo bench that hardly moves: friction and damping stay open."""
    model, folder, times = base_model("servo_bench"), tmp_path_factory.mktemp("bags"), np.arange(0.0, 1.2, 0.4)
    written = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        commands = Commands(times, 0.05 * rng.uniform(-1, 1, (len(times), 1)))
        out = simulate(model, model.mean()[None], [Scenario("steps", 1.2, seed=seed)], commands=[commands])
        out.joint_position += rng.normal(0, 0.002, out.joint_position.shape)
        measured = dataclasses.replace(out.measurement(0, 0, f"steps_{seed}", "steps"), commands=commands)
        written.append(str(write_measurement(folder, measured)))
    return written


def test_advice_is_given_for_what_is_open_and_for_nothing_else(bags: list[str], tmp_path: Path, capsys) -> None:
    budget = ["--particles", "30", "--generations", "2", "--store", str(tmp_path)]
    assert cli.main(["infer", *bags, *budget, "--advise", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    still_open = [p["name"] for p in said["parameters"] if not p["identified"]]
    assert still_open and [a["parameter"] for a in said["advice"]] == still_open
    assert all(0 <= a["left"] <= 1 and a["motion"] and a["tells"] == (a["left"] < 0.5) for a in said["advice"])
    assert isinstance(said["advice_caution"], str)
    assert "What to record next" in Path(said["report"]).read_text()


def test_without_the_option_there_is_no_advice_and_methods_that_do_not_judge_refuse_it(
    bags: list[str], tmp_path: Path, capsys
) -> None:
    given = ["infer", *bags, "--method", "prior", "--store", str(tmp_path)]
    assert cli.main([*given, "--json"]) == 0
    assert "advice" not in json.loads(capsys.readouterr().out)
    assert cli.main([*given, "--advise"]) == 2
    assert "method prior does not judge what the data tell" in capsys.readouterr().err


def test_an_inference_that_goes_on_says_so_before_it_works(
    bags: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    budget = ["--particles", "10", "--generations", "2", "--model", "servo_bench-v0"]
    given = ["infer", *bags, *budget, "--store", str(tmp_path), "--json"]

    def pressed(progress: Any, names: tuple[str, ...]) -> str:
        if progress.generation == 2:
            raise KeyboardInterrupt
        return ""

    with monkeypatch.context() as patched:
        patched.setattr(infer, "_state", pressed)
        assert cli.main(given) == 130
    assert "goes on" not in capsys.readouterr().err.partition("inference stopped")[0]
    assert cli.main(given) == 0
    assert "goes on after generation 1, where an earlier run was stopped" in capsys.readouterr().err
