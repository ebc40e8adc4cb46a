"""Which effects an episode has, and how far its parameters spread."""

import dataclasses

import numpy as np
import pytest

from tcbi_policy.environment import HexapodVectorEnv
from tcbi_policy.errors import TrainingError
from tcbi_policy.evaluation import NoisyObservation
from tcbi_policy.gaits import Gait
from tcbi_policy.randomisation import HELD_OUT, LEAST_HELD_OUT, LEAST_PARTICLES, divided, prior_of, randomised
from tcbi_sim.errors import SimError
from tcbi_sim.model import base_model

MODEL = base_model("hexapod")


def test_each_effect_is_there_in_its_share_of_the_particles_and_does_nothing_in_the_others() -> None:
    wide = randomised(MODEL, ("command_latency", "lost_commands"), share=0.25, seed=1)
    assert wide.effects == ("command_latency", "lost_commands")
    nulls = np.array([np.nan if p.null is None else p.null for p in wide.parameters])
    present = (wide.particles[:, 3:] != nulls[3:]).astype(float)
    assert present.mean(axis=0) == pytest.approx(0.25, abs=0.05)
    assert abs(np.corrcoef(present.T)[0, 1]) < 0.1  # each by itself


def test_another_seed_draws_other_values_of_the_effects() -> None:
    one, two = (randomised(MODEL, ("command_latency",), share=1.0, seed=seed).particles[:, 3] for seed in (1, 2))
    assert not set(one) & set(two)
    assert one.mean() == pytest.approx(two.mean(), rel=0.1)


def test_the_plain_parameters_keep_their_distribution() -> None:
    known = MODEL.with_particles(MODEL.particles[:20])
    wide = randomised(known, ("command_latency",))
    assert all((known.particles == row).all(axis=1).any() for row in wide.particles[:, :3])


def test_a_prior_is_as_wide_as_the_bounds_whatever_the_posterior_says() -> None:
    narrow = MODEL.with_particles(np.tile(MODEL.mean(), (5, 1)))
    units = narrow.to_unit(prior_of(narrow).particles)
    np.testing.assert_allclose(units.mean(axis=0), 0.5, atol=0.05)
    np.testing.assert_allclose(units.std(axis=0), 12**-0.5, atol=0.02)


def test_what_policies_are_compared_on_shares_no_parameters_with_what_they_are_trained_on() -> None:
    rng = np.random.default_rng(4)
    resampled = MODEL.with_particles(MODEL.particles[rng.integers(0, 20, 200)])  # with repeats, as a posterior has
    weighted = dataclasses.replace(MODEL, log_weights=rng.normal(0.0, 1.5, len(MODEL.particles)))
    for model in (resampled, weighted):
        kept, unseen = divided(model)
        assert not {tuple(p) for p in kept.particles} & {tuple(p) for p in unseen.particles}
        assert len(kept.particles) + len(unseen.particles) == len(model.particles)
        share = np.exp(unseen.log_weights - model.log_weights.max()).sum()
        share /= np.exp(model.log_weights - model.log_weights.max()).sum()
        assert HELD_OUT <= share <= HELD_OUT + 0.35
        assert np.array_equal(divided(model)[1].particles, unseen.particles)


def test_a_model_of_few_particles_is_not_divided() -> None:
    few = MODEL.with_particles(MODEL.particles[np.arange(200) % (LEAST_PARTICLES - 1)])
    assert divided(few) == (few, few)


def test_of_a_model_that_is_divided_several_vectors_are_held_out_that_bear_weight() -> None:
    for seed in range(50):
        weights = np.exp(np.random.default_rng(seed).normal(0.0, 0.5, 2 * LEAST_PARTICLES))
        model = MODEL.with_particles(MODEL.particles[: len(weights)], np.log(weights / weights.sum()))
        kept, unseen = divided(model)
        for part, least in ((unseen, LEAST_HELD_OUT), (kept, 1.0)):
            assert 1.0 / np.sum(part.weights**2) >= least - 1e-9
    even = MODEL.with_particles(MODEL.particles[:LEAST_PARTICLES])
    assert [len(part.particles) for part in divided(even)] == [LEAST_PARTICLES - 5, 5]


def test_environments_with_different_effects_run_side_by_side() -> None:
    environment = HexapodVectorEnv(randomised(MODEL, ("lost_commands", "backlash")), "balance", 16, seed=2)
    environment.reset()
    _, reward, _, _, info = environment.step(np.full((16, 18), 0.2))
    assert np.isfinite(reward).all() and not info["diverged"].any()


def test_no_effects_leave_the_model_as_it_is_and_wrong_ones_are_named() -> None:
    assert randomised(MODEL, ()) is MODEL
    with pytest.raises(SimError, match="magic"):
        randomised(MODEL, ("magic",))
    with pytest.raises(TrainingError, match="effect_share"):
        randomised(MODEL, ("backlash",), share=0.0)


def test_a_noisy_policy_sees_noise_of_the_size_that_was_asked_for() -> None:
    class Echo(Gait):
        def act(self, time: float, observation: np.ndarray) -> np.ndarray:
            return observation

    noisy = NoisyObservation(Echo("stand"), 0.08)
    noisy.reset(1000, np.random.default_rng(0))
    assert noisy.act(0.0, np.zeros((1000, 21))).std() == pytest.approx(0.08, rel=0.02)
