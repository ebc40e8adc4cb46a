"""Residuals that are no independent normal draws: what heavy tails and neighbours that are alike may do to a fit."""

import dataclasses

import numpy as np
import pytest
from bench_recordings import BASE, NOISE, record

from tcbi_infer.compare.noise import noise_floor
from tcbi_infer.compare.replay import Replay
from tcbi_infer.diagnose.fit import Fit, Fitter, Nuisance
from tcbi_infer.diagnose.problem import Problem
from tcbi_sim.measurement import Measurement
from tcbi_sim.model import base_model

MODEL = base_model("servo_bench")


def problem_of(recordings: list[Measurement]) -> Problem:
    replay = Replay.of(MODEL, recordings)
    residual = replay.measured - replay.by_rollout(replay.predict(MODEL, BASE[None])[0])
    return Problem.of(replay, noise_floor(replay.layout, replay.measured, residual, replay.replicates).values)


def fitted(problem: Problem) -> Fit:
    fitter = Fitter(problem, MODEL, Nuisance.none(problem), np.arange(len(problem.replay.replicates)), 0.002)
    return fitter.polish(fitter.run((MODEL.to_unit(BASE) + 0.02)[None]))


@pytest.fixture(scope="module")
def recordings() -> list[Measurement]:
    return record(MODEL, BASE)


def test_a_burst_of_thirty_noises_in_one_motion_does_not_move_a_fit(recordings) -> None:
    """As of a foot that slips, alike in both repeats, so that no mean takes it away."""

    def struck(m: Measurement) -> Measurement:
        late = (m.time > 2.0) & (m.time < 2.2)
        return dataclasses.replace(m, joint_position=m.joint_position + 30 * NOISE * late[:, None])

    clean = problem_of(recordings)
    burst = dataclasses.replace(
        clean, observed=problem_of([struck(recordings[0]), struck(recordings[1]), *recordings[2:]]).observed
    )
    fits = [fitted(problem) for problem in (clean, burst)]
    assert all(fit.converged for fit in fits)
    sd = 1 / np.sqrt(np.diag(fits[0].normal.sum(axis=0)))
    assert np.all(np.abs(fits[1].unit - fits[0].unit) < sd)
    squares = [0.5 * np.nansum((fit.residual[0] / clean.floor) ** 2) for fit in fits]
    assert fits[1].loss[0] - fits[0].loss[0] < 0.2 * clean.share[0] * (squares[1] - squares[0])


def test_neighbours_that_are_alike_count_for_less_and_widen_intervals(recordings) -> None:
    problem, rng = problem_of(recordings), np.random.default_rng(0)
    white = problem.floor * rng.standard_normal(problem.observed.shape)
    alike = np.zeros_like(white)
    for t in range(1, alike.shape[1]):
        alike[:, t] = 0.9 * alike[:, t - 1] + np.sqrt(1 - 0.9**2) * white[:, t]
    judged = [problem.with_autocorrelation(residual) for residual in (white, alike)]
    assert judged[0].share[0] == pytest.approx(1.0, rel=0.1)
    assert judged[1].share[0] == pytest.approx((1 - 0.9) / (1 + 0.9), rel=0.25)
    widths = [1 / np.sqrt(p.precision(0 * white, np.ones(len(p.share))).sum()) for p in judged]
    assert widths[1] == pytest.approx(np.sqrt(19) * widths[0], rel=0.15)
