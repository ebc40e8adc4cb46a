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


def test_a_longer_step_is_tried_where_the_whole_one_is_good_and_a_shorter_one_where_it_is_not(fitter, monkeypatch):
    tried = []
    predict = Fitter.predict

    def watched(self, unit):
        tried.append(np.atleast_2d(unit))
        return predict(self, unit)

    monkeypatch.setattr(Fitter, "predict", watched)
    for start, longer in ((to_unit(MODEL, BASE) + 0.03, True), (np.array([0.58, 0.11, 0.44]), False)):
        tried.clear()
        fitter.run(start[None], steps=(0.02,))
        at_start, slopes, whole, other = tried
        assert len(at_start) == len(whole) == len(other) == 1 and len(slopes) == 6
        assert (np.linalg.norm(other - start) > np.linalg.norm(whole - start)) == longer
