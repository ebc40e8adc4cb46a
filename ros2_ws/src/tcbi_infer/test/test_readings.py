"""Voltage and temperature: out of a driver's diagnostics and of logs, into what errors are set against."""

import dataclasses
import json

import numpy as np
import pytest
from bag_cases import bench, differences, rollout
from legged_cases import walk

from tcbi_contract import names
from tcbi_infer.bags import schemas
from tcbi_infer.bags.encoding import header, messages
from tcbi_infer.bags.measurement_writer import START_NS, write_measurement
from tcbi_infer.bags.reader import read_measurement
from tcbi_infer.bags.writer import BagWriter
from tcbi_infer.compare.clocks import _shifted
from tcbi_infer.compare.conditions import conditions
from tcbi_infer.compare.locate import locate
from tcbi_infer.compare.replay import Replay
from tcbi_infer.compare.signals import JOINT
from tcbi_infer.errors import MappingError
from tcbi_infer.importer import read_rollouts
from tcbi_infer.mapping import load_mapping
from tcbi_infer.readings import QUANTITIES, on_joints
from tcbi_sim.model import base_model
from tcbi_sim.rigs import load_rig

RIG = load_rig("hexapod")
TEMPERATURE = QUANTITIES[0]
READ = {
    "voltage_V": (np.array([0.1, 1.1]), np.array([7.4, 7.1])),
    "temperature_C/lf_femur": (np.array([-0.9, 0.1, 1.1]), np.array([41.0, 42.0, 44.0])),
}


def diagnostics(stamp, statuses):
    """What a node says of itself: name -> {key: value}."""
    kind = schemas.typestore().types
    return kind["diagnostic_msgs/msg/DiagnosticArray"](
        header=header(stamp, ""),
        status=[
            kind["diagnostic_msgs/msg/DiagnosticStatus"](
                level=0, name=name, message="", hardware_id="",
                values=[kind["diagnostic_msgs/msg/KeyValue"](key=k, value=v) for k, v in values.items()],
            )
            for name, values in statuses.items()
        ],
    )  # fmt: skip


def bag_with(folder, m, said):
    """A bag in which nodes also say `said`: (s, statuses) each."""
    with BagWriter(folder, m.rollout_id, {"rig": m.rig}) as bag:
        for topic, time, data in messages(m, START_NS):
            bag.write("/" + topic, time, data)
        for at, statuses in said:
            stamp = START_NS + round(at * 1e9)
            data = schemas.encode(diagnostics(stamp, statuses), schemas.MESSAGES[names.DIAGNOSTICS])
            bag.write("/" + names.DIAGNOSTICS, stamp, data)
    return bag.path


def test_a_drivers_diagnostics_become_readings(tmp_path):
    said = [
        (t, {"driver: link": {"port": "/dev/x", "late_replies": "3"},
             "driver: servos": {"voltage_V": f"{7.4 - 0.1 * t:.1f}", "temperature_C/lf_coxa": str(40 + int(t)),
                                "temperature_C/of_another_robot": "90"}})
        for t in (-3.0, -0.5, 0.0, 1.0, 2.0, 9.0)
    ]  # fmt: skip
    m = read_measurement(bag_with(tmp_path, rollout(), said))
    assert set(m.readings) == {"voltage_V", "temperature_C/lf_coxa"}
    time, volts = m.readings["voltage_V"]
    np.testing.assert_allclose(time, [-0.5, 0.0, 1.0, 2.0])
    np.testing.assert_allclose(volts, [7.5, 7.4, 7.3, 7.2], atol=0.051)
    assert m.notes == () and differences(dataclasses.replace(m, readings={}), rollout()) == []


def test_diagnostics_without_readings_or_numbers_leave_a_bag_as_it_is(tmp_path):
    said = [(t, {"servos": {"voltage_V": "unknown", "temperature_C/lf_coxa": "nan"}, "x": {}}) for t in (0.0, 1.0)]
    m = read_measurement(bag_with(tmp_path, rollout(), said))
    assert m.readings == {} and m.notes == () and differences(m, rollout()) == []


def test_readings_survive_a_bag(tmp_path):
    case = dataclasses.replace(rollout(), readings=READ)
    assert differences(case, read_measurement(write_measurement(tmp_path, case))) == []
    broken = dataclasses.replace(case, readings={**READ, "voltage_V": (READ["voltage_V"][0], np.array([7.4, 7.2]))})
    assert differences(case, broken) == ["readings"], "the comparison of this test sees a reading"


def test_readings_move_with_the_clock_of_their_rollout():
    m = _shifted(dataclasses.replace(rollout(), readings=READ), 0.5)
    np.testing.assert_allclose(m.readings["voltage_V"][0], [0.6, 1.6])


def test_a_joint_has_its_own_reading_else_the_robots_and_far_from_any_none():
    everywhere = {"temperature_C": (np.array([0.0, 2.0]), np.array([30.0, 34.0]))}
    m = dataclasses.replace(rollout(), readings={**READ, **everywhere})
    found = on_joints(m, TEMPERATURE, np.array([0.6, 30.0]))
    own, other = RIG.index("lf_femur"), RIG.index("lf_coxa")
    assert found[0, own] == pytest.approx(43.0) and found[0, other] == pytest.approx(31.2)
    assert np.isnan(found[1]).all()


MAPPING = """
rig = "motor_bench"
joints = ["servo"]
window = 1.0
[time]
column = "t"
[position]
column = "q"
[command]
column = "goal"
[readings]
"temperature_C/servo" = "temp"
voltage_V = { column = "mV", scale = 0.001 }
"""


def test_a_log_brings_its_readings_and_its_pieces_keep_their_own(tmp_path):
    mapping = tmp_path / "m.toml"
    mapping.write_text(MAPPING)
    t = np.arange(100) / 50
    rows = [{"t": x, "q": x, "goal": x, "temp": 40 + x if i % 10 == 0 else None, "mV": 7400} for i, x in enumerate(t)]
    log = tmp_path / "log.json"
    log.write_text(json.dumps({"entries": rows}))
    first, second = read_rollouts(load_mapping(mapping), log)
    time, values = second.readings["temperature_C/servo"]
    np.testing.assert_allclose(values - 40, time + 1.0)
    assert values[-1] > 41.5 and time[0] > -1.0 and len(first.readings["voltage_V"][0]) > 50
    np.testing.assert_allclose(first.readings["voltage_V"][1], 7.4)
    assert differences(second, read_measurement(write_measurement(tmp_path / "bags", second))) == []


@pytest.mark.parametrize("wrong", ['humidity = "h"', '"temperature_C/elbow" = "temp"', "voltage_V = 3"])
def test_a_reading_that_cannot_be_is_refused(tmp_path, wrong):
    mapping = tmp_path / "m.toml"
    mapping.write_text(MAPPING.split('"temperature_C')[0] + wrong)
    with pytest.raises(MappingError, match=r"readings\."):
        load_mapping(mapping)


@pytest.fixture(scope="module")
def replay():
    return Replay.of(base_model("hexapod"), walk(repeats=1))


def heated(replay, degrees):
    """The rollouts with every joint's temperature read 20 times a second; `degrees` (R, T)."""
    read = [
        dataclasses.replace(m, readings={"temperature_C": (replay.time, row)})
        for m, row in zip(replay.measurements, degrees, strict=True)
    ]
    return dataclasses.replace(replay, measurements=tuple(read))


def first_finding(replay, seconds):
    """Where joints that lag by `seconds` (R, T, J or less) are found."""
    joints = replay.layout.where(JOINT)
    predicted = replay.measured.copy()
    measured = predicted + np.random.default_rng(0).normal(0, 0.05, predicted.shape)
    measured[..., joints] -= seconds * np.gradient(predicted[..., joints], replay.time, axis=1)
    floor = np.full(predicted.shape[-1], 0.05)
    found = locate(RIG, replay.layout, replay.measurements, replay.time, measured - predicted, predicted, floor)
    return found[0]


def test_joints_that_lag_when_hot_are_told_so_with_the_temperature(replay):
    t = replay.time
    degrees = np.stack([43 + 4 * np.sin(2 * np.pi * t / 1.1 + k) for k in range(len(replay.measurements))])
    warm = heated(replay, degrees)
    first = first_finding(warm, 0.06 * (degrees >= 45)[..., None])
    assert first.phase.startswith("at 45 degC and above") or first.phase.startswith("at 46 degC and above")
    assert "All joints lag the prediction by" in first.statement and first.phase in first.statement
    assert "cannot tell" not in first.statement and "whole rollouts" not in first.statement


def test_a_temperature_that_only_rises_is_not_told_apart_from_the_time_since_start(replay):
    t = replay.time
    warm = heated(replay, np.tile(40 + 10 * t / t[-1], (len(replay.measurements), 1)))
    first = first_finding(warm, 0.06 * (t >= np.quantile(t, 2 / 3))[None, :, None])
    assert "cannot tell which is behind it" in first.statement
    assert "late in the rollouts" in first.statement and "degC and above" in first.statement


def test_a_hot_rollout_beside_cold_ones_may_differ_in_more_than_that(replay):
    hot = np.arange(len(replay.measurements))[:, None] == 0
    warm = heated(replay, np.where(hot, 50.0, 40.0) + np.zeros((1, len(replay.time))))
    assert "These are whole rollouts" in first_finding(warm, 0.06 * hot[..., None]).statement


def test_a_sensor_that_flickers_between_two_steps_is_no_condition(replay):
    def names_of(degrees):
        warm = heated(replay, degrees)
        found = conditions(warm.layout, warm.measurements, warm.time, warm.measured)
        return {c.name for c in found}

    steps = np.arange(len(replay.time)) % 2 + np.zeros((len(replay.measurements), 1))
    assert "temperature" not in names_of(40.0 + steps) and "temperature" in names_of(40.0 + 2 * steps)


def test_a_low_voltage_is_a_condition_too(replay):
    t = replay.time
    volts = 7.2 + 0.5 * np.sin(2 * np.pi * t / 0.9)
    read = tuple(dataclasses.replace(m, readings={"voltage_V": (t, volts)}) for m in replay.measurements)
    first = first_finding(dataclasses.replace(replay, measurements=read), 0.06 * (volts <= 6.95)[None, :, None])
    assert first.phase.endswith("V and below")


def test_rollouts_without_readings_have_no_such_condition(replay):
    found = conditions(replay.layout, replay.measurements, replay.time, replay.measured)
    assert not {c.name for c in found} & {q.name for q in QUANTITIES}
    assert bench().readings == {}
