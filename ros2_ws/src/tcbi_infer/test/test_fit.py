"""Fits of a servo bench whose truth is known, from starts near and far."""

import numpy as np
import pytest
from bench_recordings import BASE, record

from tcbi_infer.compare.noise import noise_floor
from tcbi_infer.compare.replay import Replay
from tcbi_infer.diagnose.fit import Fitter, Nuisance, to_unit
from tcbi_infer.diagnose.problem import Problem
from tcbi_sim.model import base_model

MODEL = base_model("servo_bench")


@pytest.fixture(scope="module")
def fitter() -> Fitter:
    replay = Replay.of(MODEL, record(MODEL, BASE))
    predicted = replay.predict(MODEL, BASE[None])
    residual = replay.measured - replay.by_rollout(predicted[0])
    floor = noise_floor(replay.layout, replay.measured, residual, replay.replicates)
    problem = Problem.of(replay, floor.values)
    return Fitter(problem, MODEL, Nuisance.none(problem), np.arange(len(replay.replicates)), 0.002)


@pytest.mark.parametrize("start", [(0.5, 0.5, 0.5), (0.8, 0.4, 0.4)])
def test_a_fit_comes_to_the_truth_and_knows_it(fitter, start):
    fit = fitter.run(np.array([start]))
    at_truth = fitter.run(to_unit(MODEL, BASE)[None], steps=())
    assert fit.converged and fit.total <= at_truth.total + 1.0
    assert fit.parameters[0] == pytest.approx(BASE[0], rel=0.05)


def test_a_fit_is_never_worse_than_its_best_start(fitter):
    starts = np.random.default_rng(0).uniform(0.1, 0.9, (5, 3))
    losses = [fitter.run(s[None], steps=()).total for s in starts]
    assert fitter.run(starts, steps=(0.05,)).total <= min(losses)


def test_a_step_that_does_what_was_expected_needs_no_other(fitter, monkeypatch):
    tried = []
    predict = Fitter.predict
    monkeypatch.setattr(
        Fitter, "predict", lambda self, unit: tried.append(len(np.atleast_2d(unit))) or predict(self, unit)
    )
    fitter.run((to_unit(MODEL, BASE) + 0.01)[None], steps=(0.02,))
    assert tried == [1, 6, 1]  # the start, both ways along three parameters, the whole step
    tried.clear()
    fitter.run(np.array([[0.95, 0.05, 0.05]]), steps=(0.02,))
    assert tried[:2] == [1, 6] and len(tried) > 3  # so far off, slopes say too little
