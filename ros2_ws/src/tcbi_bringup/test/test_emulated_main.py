"""The emulated robot's program says what it is asked for, and refuses in one line."""

import json
import os
from pathlib import Path

import pytest

from tcbi_bringup.emulated_robot import main as module
from tcbi_bringup.emulated_robot.main import main
from tcbi_bringup.emulated_robot.physics import Specimen


def test_reveal_prints_the_truth_as_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--seed", "7", "--reveal"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told == Specimen.of(7).truth()
    assert {"friction", "mass", "gain", "hidden", "strength", "effect"} <= set(told)


def test_a_named_effect_leaves_the_robots_plain_parameters_as_its_seed_drew_them() -> None:
    drawn, named = Specimen.of(7).truth(), Specimen.of(7, "none").truth()
    assert named["hidden"] == "none" and named["effect"] == {}
    assert [drawn[k] for k in ("friction", "mass", "gain")] == [named[k] for k in ("friction", "mass", "gain")]


def test_a_fault_of_its_own_ends_as_a_crash_with_a_traceback(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(_: object) -> int:
        raise ZeroDivisionError("a fault")

    monkeypatch.setattr(module, "run", broken)
    assert main([]) == os.EX_SOFTWARE
    assert "ZeroDivisionError: a fault" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--seed", "-1"], "seed is 0 or more"),
        (["--socket", "missing/folder/s"], "cannot open the experimenter's socket"),
        (["--socket", "s", "--link-path", "missing/folder/port"], "cannot open a serial port"),
        (["--socket", "s", "--link-path", "taken"], "no symbolic link"),
        (["--socket", "taken"], "no socket"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(
    arguments: list[str],
    says: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "taken").write_text("precious")
    assert main(arguments) == 1
    error = capsys.readouterr().err
    assert says in error and error.count("\n") == 1
    assert (tmp_path / "taken").read_text() == "precious" and not (tmp_path / "s").exists()


@pytest.mark.parametrize(
    ("words", "said"), [(["--hidden", "gremlins"], "coulomb_friction"), (["--trial", "-1"], "got '-1', allowed is")]
)
def test_an_unknown_effect_or_a_wrong_number_is_wrong_usage(
    words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as end:
        main(words)
    assert end.value.code == 2 and said in capsys.readouterr().err
