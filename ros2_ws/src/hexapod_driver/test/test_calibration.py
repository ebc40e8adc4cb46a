"""Calibration files: the shipped one, and every fault at once."""

import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hexapod_driver import calibration
from hexapod_driver.errors import CalibrationError
from tcbi_contract.names import JOINT_LIMIT, JOINTS


def _content() -> dict:
    joints = {name: {"servo": i + 1, "direction": 1, "zero_step": 2048} for i, name in enumerate(JOINTS)}
    return {"version": 1, "robot": "test", "joint": joints}


def test_the_shipped_calibration_has_all_joints_in_order():
    shipped = calibration.load("")
    assert tuple(shipped.joints) == JOINTS
    assert shipped.servos == tuple(range(1, 19))


@given(st.sampled_from(JOINTS), st.floats(-JOINT_LIMIT, JOINT_LIMIT))
def test_a_joint_angle_comes_back_within_half_a_step(name: str, angle: float):
    shipped = calibration.load("")
    assert shipped.to_radian(name, shipped.to_step(name, angle)) == pytest.approx(angle, abs=calibration.STEP_RAD / 2)


def test_direction_and_zero_apply():
    content = _content()
    content["joint"]["lf_femur"] = {"servo": 2, "direction": -1, "zero_step": 1000}
    robot = calibration.parse(content, "here")
    assert robot.to_step("lf_femur", math.pi / 6) == 1000 - 341
    assert robot.to_radian("lf_femur", 1100) == pytest.approx(-100 * 2 * math.pi / 4096)


def test_joints_are_in_the_contracts_order_whatever_the_files():
    content = _content()
    content["joint"] = dict(reversed(content["joint"].items()))
    assert tuple(calibration.parse(content, "here").joints) == JOINTS


def test_all_faults_are_told_at_once():
    content = _content()
    del content["joint"]["rr_tibia"]
    content["version"] = 7
    content["joint"]["tail"] = {}
    content["joint"]["lf_coxa"]["servo"] = 254
    content["joint"]["lm_coxa"]["servo"] = 3
    content["joint"]["lf_femur"]["direction"] = 0
    content["joint"]["rf_coxa"]["zero_step"] = 100
    content["joint"]["rf_femur"]["speed"] = 1
    content["joint"]["rf_tibia"]["servo"] = True
    with pytest.raises(CalibrationError) as error:
        calibration.parse(content, "here")
    text = str(error.value)
    for part in ("version: got 7", "rr_tibia is missing", "'tail'", "254", "servo 3", "direction: got 0", "got 100"):
        assert part in text
    assert "unknown key 'speed'" in text and "got True" in text
    assert "\n" not in text


def test_a_file_that_is_not_there_or_not_toml_is_named(tmp_path: Path):
    with pytest.raises(CalibrationError, match=r"no\.toml.*No such file"):
        calibration.load(str(tmp_path / "no.toml"))
    broken = tmp_path / "broken.toml"
    broken.write_text("version = ")
    with pytest.raises(CalibrationError, match="not valid TOML"):
        calibration.load(str(broken))
    with pytest.raises(CalibrationError, match="Is a directory"):
        calibration.load(str(tmp_path))


def test_joint_tables_of_the_wrong_shape_are_refused():
    with pytest.raises(CalibrationError, match="lf_coxa"):
        calibration.parse({"version": 1, "joint": {"lf_coxa": 5}}, "here")
    with pytest.raises(CalibrationError, match="missing"):
        calibration.parse({"version": 1, "joint": 3}, "here")
