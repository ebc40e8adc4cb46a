"""Fits of a servo bench whose truth is known, from starts near and far."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from bench_recordings import BASE, record

from tcbi_infer.compare.noise import noise_floor
from tcbi_infer.compare.replay import Replay
from tcbi_infer.compare.replicates import Replicates
from tcbi_infer.diagnose.at_random import at_random
from tcbi_infer.diagnose.base_fit import base_starts
from tcbi_infer.diagnose.fit import ROUNDS, Fitter, Nuisance, slopes_step
from tcbi_infer.diagnose.heldout import held_out
from tcbi_infer.diagnose.null import noise_draws
from tcbi_infer.diagnose.problem import Problem
from tcbi_infer.diagnose.screen import simulate_directions
from tcbi_infer.diagnose.slopes import Slopes
from tcbi_sim.model import Model, base_model
from tcbi_sim.parameter import Parameter

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
    fit = fitter.polish(fitter.run(np.array([start])))
    at_truth = fitter.run(MODEL.to_unit(BASE)[None], radii=())
    assert fit.converged and fit.total <= at_truth.total + 1.0
    assert fit.parameters[0] == pytest.approx(BASE[0], rel=0.05)


def test_a_fit_is_never_worse_than_its_best_start(fitter):
    starts = np.random.default_rng(0).uniform(0.1, 0.9, (5, 3))
    losses = [fitter.run(s[None], radii=()).total for s in starts]
    assert fitter.run(starts, radii=(0.05,)).total <= min(losses)


def test_a_longer_step_is_tried_where_the_whole_one_is_good_and_a_shorter_one_where_it_is_not(fitter, monkeypatch):
    tried = []
    predict = Fitter.predict

    def watched(self, unit):
        tried.append(np.atleast_2d(unit))
        return predict(self, unit)

    monkeypatch.setattr(Fitter, "predict", watched)
    for start, longer in ((MODEL.to_unit(BASE) + 0.03, True), (np.array([0.58, 0.11, 0.44]), False)):
        tried.clear()
        fitter.run(start[None], radii=(0.02,), most=1)
        at_start, whole, other = tried
        assert len(at_start) == len(whole) == len(other) == 1
        assert (np.linalg.norm(other - start) > np.linalg.norm(whole - start)) == longer


@pytest.mark.parametrize("floating", [True, False])
def test_slopes_of_a_robot_on_feet_come_from_longer_time_steps_than_the_trials(fitter, monkeypatch, floating):
    steps: list[tuple[int, float]] = []
    predict = Replay.predict

    def watched(self, model, parameters, sets=None, timestep=0.002):
        steps.append((len(np.atleast_2d(parameters)), timestep))
        return predict(self, model, parameters, sets, timestep)

    monkeypatch.setattr(Replay, "predict", watched)
    monkeypatch.setattr("tcbi_infer.diagnose.fit.load_rig", lambda _: SimpleNamespace(floating=floating))
    fine = Fitter(fitter.problem, fitter.model, fitter.scatter, fitter.sets, 0.002)
    fine.run((MODEL.to_unit(BASE) + 0.03)[None], radii=(0.02,), most=1)
    slopes = [(1, 0.005), (6, 0.005)] if floating else [(6, 0.002)]
    assert steps == [(1, 0.002), *slopes, (1, 0.002), (1, 0.002)]
    longest = [slopes_step(fitter.problem, t) for t in (0.0005, 0.005, 0.01)]
    assert longest == ([0.00125, 0.01, 0.01] if floating else [0.0005, 0.005, 0.01])


LOST = 2  # the motion that diverges


def diverge(monkeypatch, which):
    """From now on one motion diverges in predictions of a model whose (N, P) parameters `which` finds, (N,)."""
    predict = Replay.predict

    def broken(self, model, parameters, sets=None, timestep=0.002):
        predicted = predict(self, model, parameters, sets, timestep)
        if LOST in (sets or ()):
            predicted[which(model, np.atleast_2d(parameters)), list(sets).index(LOST)] = np.nan
        return predicted

    monkeypatch.setattr(Replay, "predict", broken)


def everywhere(model, parameters):
    return np.ones(len(parameters), bool)


def test_a_motion_that_diverges_at_the_point_itself_costs_the_others_no_slopes(fitter, monkeypatch):
    unit = MODEL.to_unit(BASE)
    slopes, bend = Slopes(fitter.predict).at(unit, fitter.predict(unit)[0], 0.05)
    diverge(monkeypatch, everywhere)
    left, departure = Slopes(fitter.predict).at(unit, fitter.predict(unit)[0], 0.05)
    others = np.arange(len(slopes)) != LOST
    np.testing.assert_array_equal(left[others], slopes[others])
    np.testing.assert_array_equal(departure[others], bend[others])
    assert not left[LOST].any() and not departure[LOST].any()


def test_a_fit_to_a_motion_that_diverges_at_every_start_has_not_converged(fitter, monkeypatch):
    fitter = Fitter(fitter.problem, MODEL, fitter.scatter, fitter.sets, 0.005)
    good = dataclasses.replace(fitter.run(MODEL.to_unit(BASE)[None], radii=()), converged=True)
    assert fitter.polish(good).converged
    diverge(monkeypatch, everywhere)
    fit = fitter.run(np.array([[0.5, 0.5, 0.5]]), radii=(0.05, 0.03))
    assert fit.total == np.inf and not fit.converged
    assert np.isfinite(fit.unit).all() and np.isfinite(fit.normal).all() and np.isfinite(fit.square).all()
    assert not fitter.polish(good).converged


@pytest.mark.parametrize(
    ("falls", "steps", "converged"), [([50, 50, 0], 4, True), ([0], 2, True), ([50] * 20, 2 * ROUNDS, False)]
)
def test_a_fit_is_polished_until_its_loss_stays(fitter, monkeypatch, falls, steps, converged):
    begun = fitter.run(MODEL.to_unit(BASE)[None], radii=())
    total, trials, stepped, left = fitter.total, fitter.trials, [], list(falls)

    def step(place, *slopes):
        stepped.append(slopes)
        here = total(place.residual, place.nuisance, place.scale)
        fall = left.pop(0) if left else 0
        away = trials(np.clip(place.unit + 0.02, 0.0, 1.0)[None], place.nuisance, place.scale)[0]
        return here, [dataclasses.replace(away, total=here - fall)]

    monkeypatch.setattr(fitter, "_stepped", step)
    assert fitter.polish(begun).converged == converged
    assert len(stepped) == steps


def test_a_fit_goes_on_where_its_valley_ends_at_the_bounds(fitter, monkeypatch):
    monkeypatch.setattr("tcbi_infer.diagnose.fit.points_along", lambda model, unit, direction: np.empty((0, 3)))
    assert np.isfinite(fitter.run(np.array([[0.5, 0.5, 0.5]])).total)


def test_a_use_that_diverges_at_every_size_is_not_said_to_change_nothing(fitter, monkeypatch):
    base = fitter.run(MODEL.to_unit(BASE)[None], radii=())
    diverge(monkeypatch, lambda model, parameters: np.full(len(parameters), "backlash" in model.effects))
    uses = ("backlash", "command_latency")
    found = simulate_directions(fitter.problem, base, uses, fitter.sets, 0.005)
    assert (found.uses, found.untestable, found.diverging) == (("command_latency",), (), ("backlash",))


def test_a_use_by_which_commands_get_lost_is_not_simulated_unless_the_base_model_loses_them_too(fitter):
    base = fitter.run(MODEL.to_unit(BASE)[None], radii=())
    found = simulate_directions(fitter.problem, base, ("lost_commands", "backlash"), fitter.sets, 0.005)
    assert (found.uses, found.untestable, found.random) == (("backlash",), (), ("lost_commands",))
    assert not at_random(base.model.with_effect("lost_commands"), "backlash")


def test_uses_show_in_the_motions_in_which_the_base_model_does_not_diverge(fitter, monkeypatch):
    base = fitter.run(MODEL.to_unit(BASE)[None], radii=())
    diverge(monkeypatch, everywhere)
    found = simulate_directions(fitter.problem, base, ("backlash",), fitter.sets, 0.005)
    assert found.uses == ("backlash",) and not (found.untestable or found.diverging)
    assert not found.change[:, LOST].any() and found.change.any()


def test_a_single_kind_of_motion_is_predicted_by_its_own_fit_with_the_scatter_between_joints(fitter):
    shift = 0.02 * np.sin(np.arange(fitter.problem.observed.shape[1]))[:, None]
    shifted = dataclasses.replace(fitter.problem, observed=fitter.problem.observed + 2.0 * shift)
    scatter = Nuisance(np.broadcast_to(shift[..., None], (*shifted.observed.shape, 1)), ("joint",))
    one = np.array([LOST])
    fit = Fitter(shifted, MODEL, scatter, one, 0.002).run(MODEL.to_unit(BASE)[None], radii=(0.02,))
    held = held_out(shifted, fit, one, 0.002)
    assert fit.nuisance[0] > 1.0 and held.unit[0] == pytest.approx(fit.unit)
    np.testing.assert_allclose(held.residual, fit.residual, atol=1e-6)


@pytest.mark.parametrize(("width", "count"), [(3, 27), (5, 32), (7, 128), (8, 128), (12, 128)])
def test_a_fit_starts_at_different_corners_in_both_halves_of_every_range(width, count):
    parameters = tuple(Parameter(f"p{i}", "1", 0.0, 1.0, 0.5, description="") for i in range(width))
    model = Model("wide-v0", "hexapod", (), parameters, np.full((1, width), 0.5), np.zeros(1))
    grid = base_starts(model)[2:]
    assert grid.shape == (count, width) and len(np.unique(grid, axis=0)) == count
    upper = (grid > 0.5).mean(axis=0)
    assert np.all((upper > 0.3) & (upper < 0.7)) and np.array_equal(grid, base_starts(model)[2:])


def test_a_recording_given_twice_is_no_repeat_without_noise(fitter):
    drawn = []
    for times in (1, 2):
        sets = tuple(Replicates(g.members[:1] * times, g.kind) for g in fitter.problem.replay.replicates)
        problem = dataclasses.replace(
            fitter.problem, replay=dataclasses.replace(fitter.problem.replay, replicates=sets)
        )
        drawn.append(noise_draws(problem, fitter.sets, 3, np.random.default_rng(0)))
    np.testing.assert_allclose(*drawn)
