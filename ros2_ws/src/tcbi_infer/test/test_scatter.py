"""Each joint's own gain: found beside what jumps, kept by the version that a diagnosis makes."""

import dataclasses
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from legged_cases import walk
from scipy.linalg import hadamard

from tcbi_infer.compare import compare
from tcbi_infer.compare.replay import Replay
from tcbi_infer.diagnose import diagnose
from tcbi_infer.diagnose import scatter as module
from tcbi_infer.diagnose.adopt import adopt
from tcbi_infer.diagnose.fit import Fitter, Nuisance
from tcbi_infer.diagnose.least_squares import bounded_step
from tcbi_infer.diagnose.problem import Problem
from tcbi_infer.diagnose.scatter import joint_gains, joint_scatter, relinearised, slopes
from tcbi_infer.diagnose.screen import Screen, simulate_directions
from tcbi_infer.diagnose.settings import QUICK
from tcbi_sim.model import Model, base_model
from tcbi_sim.scatter import SCATTER

SIGNS = hadamard(32)[:, 1:19].astype(float)
RNG = np.random.default_rng(0)
TRUE = RNG.normal(size=(18, 40))


def test_slopes_are_exact_where_predictions_are_linear():
    np.testing.assert_allclose(slopes(SIGNS, 5.0 + SIGNS @ TRUE), TRUE.T, atol=1e-12)


def test_jumps_of_a_simulation_weigh_an_nth():
    jumps = RNG.normal(size=(32, 40))
    assert (slopes(SIGNS, SIGNS @ TRUE + jumps).T - TRUE).std() == pytest.approx(1 / np.sqrt(32), rel=0.1)


def test_what_diverged_bends_slopes_only_as_much_as_it_lacks():
    predicted = SIGNS @ TRUE
    predicted[3, :20] = predicted[:, 39] = np.nan
    found = slopes(SIGNS, predicted).T
    np.testing.assert_allclose(found[:, 20:39], TRUE[:, 20:39], atol=1e-12)
    assert (found[:, 39] == 0.0).all() and 0 < np.abs(found[:, :20] - TRUE[:, :20]).max() < 1.0


def test_gains_are_those_that_the_model_knows_times_what_was_fitted():
    def gains_of(model: Model, *deviations: float) -> tuple[float, ...]:
        joints = ("lf_femur", "rr_tibia")[: len(deviations)]
        scatter = Nuisance(np.zeros((1, 1, 1, len(joints))), joints)
        fit: Any = SimpleNamespace(model=model, scatter=scatter, nuisance=np.array(deviations))
        return joint_gains(fit)

    model = base_model("hexapod")
    found = gains_of(model, 1.0, -2.0)
    assert found == (1.0, 1.0 + SCATTER, *[1.0] * 15, 1.0 - 2 * SCATTER)
    again = gains_of(dataclasses.replace(model, joint_gains=found), 1.0, 0.0)
    assert again == pytest.approx((1.0, (1.0 + SCATTER) ** 2, *[1.0] * 15, 1.0 - 2 * SCATTER))
    assert gains_of(model) == ()


def a_fit(at: float, taken_at: float, total: float = 1.0, names: tuple[str, ...] = ("lf_femur",)) -> Any:
    """A fit of one base parameter and one effect, and where the slopes of its scatter were taken."""
    scatter = Nuisance(np.zeros((1, 1, 1, len(names))), names, np.array([taken_at]))
    return SimpleNamespace(model=None, unit=np.array([at, 0.9]), scatter=scatter, total=total)


@pytest.fixture
def runs(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Fits that go two thirds of the way to 0.8 with slopes of where they start; where those were taken."""
    taken: list[float] = []

    class Fake:
        def __init__(self, problem: Any, model: Any, scatter: float, *_: Any) -> None:
            self.scatter = scatter

        def run(self, units: np.ndarray, radii: Sequence[float]) -> Any:
            return a_fit(units[0, 0] + (0.8 - units[0, 0]) * 2 / 3, self.scatter)

    def scatter_at(problem: Any, fit: Any, *_: Any) -> float:
        taken.append(float(fit.unit[0]))
        return taken[-1]

    monkeypatch.setattr(module, "Fitter", Fake)
    monkeypatch.setattr(module, "joint_scatter", scatter_at)
    return taken


def test_a_fit_far_from_where_its_slopes_were_taken_goes_on_with_its_own_until_it_stays(runs):
    nothing: Any = None
    found = relinearised(nothing, a_fit(0.5, 0.2), np.arange(1), 0.005)
    assert runs == pytest.approx([0.5, 0.7, 0.8 - 0.1 / 3]) and found.unit[0] == pytest.approx(0.8 - 0.1 / 9)


def test_slopes_of_nearby_are_good_enough_and_none_are_taken_where_there_is_nothing_to_tell(runs):
    nothing: Any = None
    for fit in (a_fit(0.5, 0.46), a_fit(0.5, 0.2, total=np.inf), a_fit(0.5, 0.2, names=())):
        assert relinearised(nothing, fit, np.arange(1), 0.005) is fit
    assert runs == []


def test_the_version_that_a_diagnosis_makes_knows_the_gains_and_predicts_better_by_them():
    model = base_model("hexapod")
    gains = 1.0 + SCATTER * np.random.default_rng(1).normal(size=18)
    robot = dataclasses.replace(model, joint_gains=tuple(gains / np.exp(np.log(gains).mean())))
    values = np.array([0.7, 0.75, 2.0])
    recorded = walk(robot, values, count=5, timestep=0.0005)
    seen, unseen = recorded[:-4], recorded[-4:]
    settings = dataclasses.replace(QUICK, escape=False)
    fitted = adopt(model, "", diagnose(model, seen, uses=[], settings=settings).to_json())
    assert np.corrcoef(fitted.joint_gains, robot.joint_gains)[0, 1] > 0.8
    alike = dataclasses.replace(fitted, joint_gains=())
    error, before = (compare(m, unseen, particles=0).error_over_floor for m in (fitted, alike))
    assert error - 1.0 < 0.8 * (before - 1.0)


def test_one_servo_that_is_much_softer_is_found_beside_the_scatter():
    """Though the scatter is a nuisance that takes up all that is linear in a gain."""
    odd, model, values = "gain_scatter:rf_tibia", base_model("hexapod"), np.array([0.7, 0.75, 2.0])
    replay = Replay.of(model, walk(model.with_effect(odd), np.append(values, 0.55), count=3))
    predicted = replay.predict(model, values[None], timestep=0.005)
    problem = Problem.of(replay, replay.noise_floor(replay.measured - replay.by_rollout(predicted[0])).values)
    sets = np.arange(3)
    start = Fitter(problem, model, Nuisance.none(problem), sets, 0.005).run(model.to_unit(values)[None], radii=())
    fitter = Fitter(problem, model, joint_scatter(problem, start, sets, 0.005), sets, 0.005)
    base = fitter.run(start.unit[None], radii=(0.08,))
    uses = (odd, "gain_scatter:lm_tibia", "weak_leg:rf")
    screen = Screen(problem, base, simulate_directions(problem, base, uses, sets, 0.005), sets)
    _, _, refitted, _ = screen.solve(screen.data, sets)
    step = bounded_step(base.normal.sum(axis=0), base.slope.sum(axis=0), base.unit, base.nuisance)
    assert refitted[:, 0] == pytest.approx(step + np.r_[np.zeros(3), base.nuisance], abs=1e-3)
    found, other, leg = screen.held_out(screen.data)[:, :, 0].sum(axis=0)
    assert found > 1.2 * max(leg, other) and found > 20.0  # nats; with the slopes of a small change -98 beside 62
