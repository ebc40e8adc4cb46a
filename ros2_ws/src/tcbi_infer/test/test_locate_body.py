"""Errors planted in attitude, rates and contacts get a sentence, a phase and the moment that shows them."""

import dataclasses
import json

import numpy as np
import pytest
from legged_cases import walk

from tcbi_infer.compare.comparison import compare
from tcbi_infer.compare.locate import locate
from tcbi_infer.compare.replay import Replay
from tcbi_infer.compare.signals import ATTITUDE, CONTACT, RATE
from tcbi_infer.compare.worst import worst
from tcbi_infer.report import Report, add_comparison
from tcbi_sim.model import base_model
from tcbi_sim.rigs import load_rig

RIG, MODEL = load_rig("hexapod"), base_model("hexapod")


@pytest.fixture(scope="module")
def replay():
    return Replay.of(MODEL, walk(repeats=1))


def located(replay, name, change):
    """What is found where a channel departs by `change` (R, T) times its floor from the prediction."""
    predicted = np.nan_to_num(replay.measured)
    floor = np.full(predicted.shape[-1], 0.05)
    error = np.random.default_rng(0).normal(0, 0.05, predicted.shape)
    error[..., replay.layout.index(name)] += 0.05 * change
    return locate(RIG, replay.layout, replay.measurements, replay.time, error, predicted, floor)


def late(replay):
    t = replay.time
    return (t >= np.quantile(t, 2 / 3)) * np.ones((len(replay.measurements), 1))


@pytest.mark.parametrize("name", ["pitch", "rate_z", "contact_lr"])
def test_a_body_signal_that_errs_late_is_told_with_its_phase_and_moment(replay, name):
    (found,) = located(replay, name, 20.0 * late(replay))
    assert name in found.channels and found.phase == "late in the rollouts"
    assert "It is worst late in the rollouts" in found.statement
    assert replay.layout.channels[found.moment.channel].name == name
    assert found.moment.inside.any() and found.rms > 5 * found.elsewhere


def test_an_error_all_over_has_a_moment_and_no_phase(replay):
    bump = np.ones_like(late(replay)) * 10.0
    bump[1, 40:70] = 12.0
    (found,) = located(replay, "roll", bump)
    assert found.phase == "" and "constant offset" in found.statement and "worst" not in found.statement
    assert found.moment.rollout == 1 and abs(found.moment.first - 20) <= 25


def test_a_tilt_that_comes_with_the_heat_says_what_else_it_may_be(replay):
    t = replay.time
    degrees = 40 + 10 * t / t[-1]
    warm = [dataclasses.replace(m, readings={"temperature_C": (t, degrees)}) for m in replay.measurements]
    (found,) = located(dataclasses.replace(replay, measurements=tuple(warm)), "pitch", 20.0 * late(replay))
    assert "cannot tell which is behind it" in found.statement
    assert "degC and above" in found.statement and "late in the rollouts" in found.statement


def test_the_worst_moments_are_over_each_signals_own_floor(replay):
    predicted = replay.measured.copy()
    floor = np.full(predicted.shape[-1], 1.0)
    rate, pitch = replay.layout.index("rate_x"), replay.layout.index("pitch")
    floor[rate], floor[pitch] = 100.0, 0.01
    predicted[0, :40, rate] += 300.0
    predicted[1, 60:, pitch] += 0.2
    predicted[0, :40, 3] += 2.0
    first, second = worst(replay, predicted, floor, 2)
    assert (first.signal, second.signal) == ("pitch", "rate_x"), "a joint that errs by twice its floor errs less"
    assert second.error_over_floor == pytest.approx(second.error / 100.0) and second.time < 0.2
    assert first.rollout == replay.measurements[1].rollout_id and first.index[2] == pitch


def test_signals_that_no_fit_looks_at_are_no_worst_moment(replay):
    predicted = replay.measured.copy()
    predicted[..., replay.layout.where(CONTACT)] += 5.0
    assert worst(replay, predicted, np.ones(predicted.shape[-1])) == []


@pytest.fixture(scope="module")
def tilted():
    """A comparison with rollouts whose IMU is tilted by 3 deg in the second half."""
    rollouts = []
    for m in walk():
        half = m.time > 0.5 * m.time[-1]
        tilt = np.where(half, np.radians(3.0) / 2, 0.0)
        attitude = m.attitude + np.stack([0 * tilt, 0 * tilt, tilt, 0 * tilt], axis=-1)
        attitude /= np.linalg.norm(attitude, axis=-1, keepdims=True)
        rollouts.append(dataclasses.replace(m, attitude=attitude))
    return compare(MODEL, rollouts, particles=2)


def test_json_holds_the_phase_the_moment_and_the_worst(tilted):
    said = json.loads(json.dumps(tilted.to_json()))
    first = said["where"][0]
    assert {"pitch"} <= set(first["signals"]) and first["phase"] == "late in the rollouts"
    assert first["moment"]["signal"] == "pitch" and first["moment"]["until"] > 1.5
    assert first["moment"]["rollout"] in said["rollouts"]
    assert said["worst"][0]["signal"] == "pitch"
    assert {"rollout", "time", "signal", "error", "error_over_floor"} <= set(said["worst"][0])
    assert 1 < len(said["worst"]) <= 10
    ratios = [w["error_over_floor"] for w in said["worst"]]
    assert ratios == sorted(ratios, reverse=True)


def test_the_report_shows_the_body_folded_and_the_moment_of_its_sentence(tilted):
    report = Report("x")
    add_comparison(report, tilted)
    page = report.html()
    assert "1. pitch in motion" in page
    fold = page.index("<summary>Measured and predicted attitude, body rates, foot contacts, distance</summary>")
    assert fold < page.index("Distance in motion") < page.index("</details>", fold)
    section = next(s for s in report.sections if s.title == "The body")
    drawn = dict(zip([f.caption.split(" in ")[0] for f in section.figures], section.figures, strict=True))
    for group, title in ((ATTITUDE, "Attitude"), (RATE, "Body rates"), (CONTACT, "Foot contacts")):
        count = len(tilted.replay.layout.where(group))
        assert drawn[title].svg.count("FillBetweenPolyCollection") >= count > 1


def test_distance_has_its_band(tilted):
    d = tilted.distance
    there = np.isfinite(d.measured)
    assert there.any() and np.all(d.low[there] < d.high[there])
    assert np.mean((d.predicted[there] > d.low[there] - 0.05) & (d.predicted[there] < d.high[there] + 0.05)) > 0.9
    bare = [dataclasses.replace(m, position=None) for m in walk(count=1)]
    assert compare(MODEL, bare, particles=0).distance is None
