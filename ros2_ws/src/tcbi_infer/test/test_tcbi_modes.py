"""Where two values explain the rollouts equally well, both are kept, within an inference and from one to the next."""

import numpy as np
import pytest
from tcbi_cases import bench_rollouts, normal_problem

from tcbi_infer.tcbi import calibrated
from tcbi_infer.tcbi.driver import infer
from tcbi_infer.tcbi.modes import modes, told
from tcbi_infer.tcbi.prior import MODEL, Prior, about
from tcbi_infer.tcbi.problem import Problem
from tcbi_infer.tcbi.proposal import to_probit
from tcbi_infer.tcbi.weights import normalised
from tcbi_sim.model import Model, base_model
from tcbi_sim.parameter import Parameter

LOW, HIGH = 0.2, 0.8  # equally good, since only the distance from the middle shows


def symmetric(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Particles (M, 2) and weights of an inference in which the first parameter acts as |2 u - 1|, the second not."""
    observed, simulate, _ = normal_problem(HIGH - LOW, seed)
    settings = calibrated.CalibratedSettings(particles=50, generations=5)
    state = calibrated.init(2)
    while not calibrated.finished(state, settings):
        rng = np.random.default_rng([seed, state.generation])
        state, _ = calibrated.step(rng, state, lambda unit: simulate(np.abs(2 * unit - 1)), observed, settings)
    unit, log_weights = calibrated.posterior(state)
    return unit, normalised(log_weights)


@pytest.mark.parametrize("seed", range(3))
def test_an_inference_keeps_both_of_two_symmetric_modes(seed: int) -> None:
    unit, weights = symmetric(seed)
    low = unit[:, 0] < 0.5
    assert 0.2 < weights[low].sum() < 0.8
    assert weights[low] @ unit[low, 0] / weights[low].sum() == pytest.approx(LOW, abs=0.05)
    assert weights[~low] @ unit[~low, 0] / weights[~low].sum() == pytest.approx(HIGH, abs=0.05)
    assert len(modes(to_probit(unit), weights)) == 2
    said = told([Parameter("u", "m", 0.0, 1.0, 0.5), Parameter("idle", "1", 0.0, 1.0, 0.5)], unit, weights)
    assert said.startswith("2 separate modes, which differ most in u (") and " m, " in said


@pytest.mark.parametrize(("share", "count"), [(0.03, 2), (0.001, 1)])
def test_particles_far_off_that_bear_no_weight_to_speak_of_are_no_mode(share: float, count: int) -> None:
    z = np.concatenate([np.random.default_rng(0).normal(0.0, 0.1, (60, 1)), np.linspace(2.9, 3.1, 20)[:, None]])
    weights = np.r_[np.full(60, (1 - share) / 60), np.full(20, share / 20)]
    assert len(modes(z, weights)) == count


def two_modes() -> Model:
    """A quarter of the particles at one gain, the others at another; damping goes along, friction is one normal."""
    model, rng = base_model("servo_bench"), np.random.default_rng(0)
    high = rng.random(400) < 0.75
    centre = np.where(high[:, None], [0.7, 0.6, 0.5], [0.3, 0.4, 0.5])
    unit = np.clip(rng.normal(centre, [0.04, 0.05, 0.1]), 0.01, 0.99)
    return model.with_particles(model.from_unit(unit), rollouts=[])


def test_going_on_from_a_version_with_two_modes_keeps_both_and_says_so() -> None:
    model = two_modes()
    unit = Prior.of(model).unit(np.random.default_rng(1).random((20000, 3)))
    own = model.to_unit(model.particles)
    between = np.abs(unit[:, 0] - 0.5) < 0.05
    assert between.mean() < 0.005, "one normal for both has most of its mass in between"
    assert np.mean(unit[:, 0] > 0.5) == pytest.approx(np.mean(own[:, 0] > 0.5), abs=0.01)
    np.testing.assert_allclose(unit.mean(axis=0), own.mean(axis=0), atol=0.01)
    np.testing.assert_allclose(np.cov(unit.T), np.cov(own.T), atol=0.003)
    (line,) = about(model, MODEL)
    assert "2 separate modes, which differ most in gain" in line


def test_a_posterior_of_two_modes_is_said_in_the_result() -> None:
    measurements = bench_rollouts(count=2, duration=1.0)[1]
    result = infer(Problem.of(two_modes(), measurements, prior=MODEL), "prior")
    assert any(line.startswith("the posterior has 2 separate modes") for line in result.warnings)


@pytest.mark.parametrize("shape", ["normal", "uniform", "exponential"])
def test_one_mode_is_not_taken_for_two(shape: str) -> None:
    """Few particles of unequal weight, as an inference leaves them; 40 draws of 3 parameters.

    Were one parameter in 150 split, more than three draws would be in 1 % of such tests.
    """
    split = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        draw = {"normal": rng.standard_normal, "uniform": rng.random, "exponential": rng.standard_exponential}[shape]
        z, weights = draw((60, 3)), normalised(rng.normal(0.0, 0.7, 60))
        split += len(modes(z, weights)) > 1
    assert split <= 3


def test_too_few_particles_are_one_mode_and_equal_ones_too() -> None:
    z = np.array([[-2.0]] * 4 + [[2.0]] * 4)
    assert len(modes(z, np.full(8, 1 / 8))) == 1
    assert len(modes(np.repeat(z, 5, axis=0), np.full(40, 1 / 40))) == 2
    assert len(modes(np.zeros((40, 2)), np.full(40, 1 / 40))) == 1


def test_a_version_of_three_modes_keeps_three() -> None:
    model, rng = base_model("servo_bench"), np.random.default_rng(0)
    unit = np.clip(rng.normal(np.repeat([0.2, 0.5, 0.8], 100)[:, None], 0.02, (300, 3)), 0.01, 0.99)
    prior = Prior.of(model.with_particles(model.from_unit(unit), rollouts=[]))
    assert prior.shares == pytest.approx([1 / 3] * 3) and len(prior.means) == 3
