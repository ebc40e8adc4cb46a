"""Other valleys of a loss whose floor runs along all forces scaled alike, as a robot's on feet does."""

import dataclasses

import numpy as np
import pytest
from bench_recordings import BASE, record

from tcbi_infer.compare.noise import noise_floor
from tcbi_infer.compare.replay import Replay
from tcbi_infer.diagnose import escape
from tcbi_infer.diagnose.escape import DRIFTED, FACTOR, SHIFT, rescaled, resized
from tcbi_infer.diagnose.fit import Fitter, Nuisance
from tcbi_infer.diagnose.problem import Problem
from tcbi_sim.model import base_model

MODEL = base_model("servo_bench")
WALLS, FLOOR = 30.0, 3.0  # noise floors by which a prediction changes with a ratio of forces, and with all of them


@pytest.fixture
def fitter(monkeypatch: pytest.MonkeyPatch) -> Fitter:
    """Predictions of three signals in turn: of two ratios of forces, and weakly of their common size."""
    replay = Replay.of(MODEL, record(MODEL, BASE))
    residual = replay.measured - replay.by_rollout(replay.predict(MODEL, BASE[None])[0])
    floor = noise_floor(replay.layout, replay.measured, residual, replay.replicates)
    problem = Problem.of(replay, floor.values)
    turn = np.arange(problem.observed.shape[1])[:, None] // 7 % 3  # (T, 1)

    def predicted(self: Fitter, unit: np.ndarray, _: float) -> np.ndarray:
        gain, damping, friction = np.log(self.model.from_unit(np.atleast_2d(unit)) / BASE).T
        bent = WALLS * (gain - damping + 0.3 * np.tanh(2 * gain))
        told = np.stack([bent, WALLS * (damping - friction), FLOOR * gain])
        return problem.observed[self.sets] + problem.floor * told.T[:, turn][:, None]

    monkeypatch.setattr(Fitter, "_predicted", predicted)
    return Fitter(problem, MODEL, Nuisance.none(problem), np.arange(len(replay.replicates)), 0.005)


@pytest.mark.parametrize("factor", [0.4, 0.75, 1.6, 2.5])
def test_a_fit_at_the_wall_of_the_valley_finds_the_forces_all_of_which_are_wrong(fitter, factor):
    stuck = fitter.run(MODEL.to_unit(factor * BASE)[None], radii=())
    found = rescaled(fitter, stuck)
    assert found.total < stuck.total
    assert found.parameters[0] == pytest.approx(BASE[0], rel=FACTOR - 1.0)


def test_the_best_place_of_the_valley_is_kept(fitter):
    fit = fitter.run(MODEL.to_unit(BASE)[None], radii=(0.05,))
    assert rescaled(fitter, fit).total <= fit.total


def test_where_the_forces_are_at_their_bounds_or_the_fit_diverged_it_stays(fitter, monkeypatch):
    fit = fitter.run(MODEL.to_unit(BASE)[None], radii=())
    monkeypatch.setattr("tcbi_infer.diagnose.escape.scaled_freely", lambda *_: None)
    assert rescaled(fitter, fit) is fit
    lost = dataclasses.replace(fit, loss=np.full_like(fit.loss, np.inf))
    assert rescaled(fitter, lost) is lost


@pytest.mark.parametrize(
    ("unit", "null", "drift", "looked"),
    [("N m", 0.0, 0.05, True), ("N m", 0.0, 0.02, False), ("N m", None, 0.05, False), ("kg", 0.0, 0.0, True)],
)
def test_another_size_is_looked_for_where_it_hangs_on_the_time_step_or_is_a_mass(
    fitter, monkeypatch, unit, null, drift, looked
):
    """Of the second of three parameters, the first being the base model's."""
    base, second, third = MODEL.parameters
    second = dataclasses.replace(second, low=0.0, null=null, scale="linear", unit=unit)
    model = dataclasses.replace(MODEL, parameters=(base, second, third))
    fitter = Fitter(fitter.problem, model, fitter.scatter, fitter.sets, fitter.timestep)
    fit = dataclasses.replace(fitter.run(MODEL.to_unit(BASE)[None], radii=()), model=model)
    coarse = dataclasses.replace(fit, unit=fit.unit - drift * np.eye(3)[1])
    followed = []
    monkeypatch.setattr(escape, "_followed", lambda fitter, fit, ways: followed.append([w.args for w in ways]) or fit)
    assert resized(fitter, fit, coarse, 1) is fit
    assert followed == [[(1, SHIFT), (1, -SHIFT)]] * looked and 0.02 < DRIFTED < 0.05


def test_a_mass_is_followed_though_its_moment_moved_farther(fitter, monkeypatch):
    base, *own = MODEL.parameters
    mass, moment = (dataclasses.replace(p, low=0.0, null=0.0, scale="linear") for p in own)
    model = dataclasses.replace(MODEL, parameters=(base, dataclasses.replace(mass, unit="kg"), moment))
    fitter = Fitter(fitter.problem, model, fitter.scatter, fitter.sets, fitter.timestep)
    fit = dataclasses.replace(fitter.run(MODEL.to_unit(BASE)[None], radii=()), model=model)
    followed = []
    monkeypatch.setattr(escape, "_followed", lambda fitter, fit, ways: followed.append(ways[0].args[0]) or fit)
    resized(fitter, fit, dataclasses.replace(fit, unit=fit.unit - 0.05 * np.eye(3)[2]), 1)
    assert followed == [1]
