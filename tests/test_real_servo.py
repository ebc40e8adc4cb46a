"""Real recordings of a servo: the error on a trajectory that no fit has seen falls with load-dependent friction."""

import importlib.util
from pathlib import Path

import pytest

BENCH = Path(__file__).resolve().parents[1] / "bench" / "servo_log.py"


@pytest.mark.real_data
@pytest.mark.slow
@pytest.mark.timeout(900)
def test_load_friction_lowers_the_error_on_the_trajectory_held_out_first(real_data, monkeypatch):
    spec = importlib.util.spec_from_file_location("servo_log", BENCH)
    assert spec is not None and spec.loader is not None
    servo_log = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(servo_log)
    monkeypatch.setattr(servo_log, "DATA", real_data / "xl330_pendulum")
    *errors, ratio = servo_log.measure(quick=True)
    assert [f["name"] for f in errors] == ["lift_and_drop held out, base", "lift_and_drop held out, load_friction"]
    assert ratio["value"] < 0.6, "0.36 when it was measured"
