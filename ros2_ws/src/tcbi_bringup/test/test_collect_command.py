"""`./tcbi collect` asks the operator, and goes on only when somebody has answered."""

import io
import math
import sys
from types import SimpleNamespace

import pytest

from tcbi_bringup import cli
from tcbi_bringup.commands import collect
from tcbi_bringup.errors import BringupError

GROUND = SimpleNamespace(slope_roll=0.1, slope_pitch=0.0, yaw=0.0, blocks=())


@pytest.mark.parametrize("gone", [None, io.StringIO("")])
@pytest.mark.parametrize("ask", [lambda: collect._place(GROUND), lambda: collect._ask_distance("walk")])
def test_the_end_of_standard_input_is_no_answer(gone, ask, monkeypatch):
    monkeypatch.setattr(sys, "stdin", gone)
    with pytest.raises(BringupError, match="standard input has ended, so nobody can answer --place or --ask-distance"):
        ask()


@pytest.mark.parametrize(
    ("typed", "distance"),
    [("\n", math.nan), ("0.42\n", 0.42), ("far\n-0.1\n", -0.1), ("inf\nnan\n0.3\n", 0.3)],
)
def test_a_distance_is_a_finite_number_or_unknown(typed, distance, monkeypatch, capsys):
    monkeypatch.setattr(sys, "stdin", io.StringIO(typed))
    assert collect._ask_distance("walk") == pytest.approx(distance, nan_ok=True)
    assert capsys.readouterr().err.count("is no number of metres") == typed.count("\n") - 1


def test_nothing_is_collected_without_a_robot(capsys):
    assert cli.main(["collect", "--robot", "none"]) == 2
    assert "--robot: got none, allowed is running, sim, emulated or a serial port" in capsys.readouterr().err
