"""A model in which each particle has some effects and not others: domain randomisation beyond the plain parameters.

    wide = randomised(model, ("command_latency", "lost_commands"), share=0.5)
    environment = HexapodVectorEnv(wide, "balance", 64, observation_noise=0.02)

The result is a model like any other, so that training, evaluation and the card of a policy need to know nothing more.
"""

import dataclasses
import zlib

import numpy as np

from tcbi_contract.errors import describe
from tcbi_policy.errors import TrainingError
from tcbi_sim.model import Model

PARTICLES = 1024
HELD_OUT = 0.25  # of a model's weight, at least
LEAST_HELD_OUT = 5  # parameter vectors that bear weight
LEAST_PARTICLES = 12  # that bear weight: fewer are not divided
ROUNDING = 1e-9  # of an effective number


def prior_of(model: Model, seed: int = 0) -> Model:
    """The model's structure with every parameter as wide as its prior."""
    units = np.random.default_rng([seed, 32452843]).random((PARTICLES, len(model.names)))
    return model.with_particles(model.from_unit(units), prior_of=model.version)


def divided(model: Model) -> tuple[Model, Model]:
    """The model with the particles to train on, and with those that only a comparison of policies may see.

    No parameter vector is in both, and at least `LEAST_HELD_OUT` bear the weight of the second. Where so few particles
    bear weight that neither part would stand for the posterior, both are the whole model.

    Args:
      model: with its particles, of which some may be equal. They alone decide the division, so that no training that
        is judged on this model has seen what another one is judged on.
    """
    vectors, member = np.unique(model.particles, axis=0, return_inverse=True)
    weight = np.bincount(member.ravel(), model.weights, len(vectors))
    if 1.0 / np.sum(weight**2) < LEAST_PARTICLES - ROUNDING:
        return model, model
    seed = zlib.crc32(vectors.tobytes())
    order = np.random.default_rng([seed, 67867967]).permutation(len(vectors))
    total = np.cumsum(weight[order])
    bearing = total**2 / np.cumsum(weight[order] ** 2)  # effective number of vectors
    count = int(np.argmax((total >= HELD_OUT) & (bearing >= LEAST_HELD_OUT - ROUNDING))) + 1
    held_out = np.isin(member.ravel(), order[:count])
    kept, judged = (
        dataclasses.replace(model, particles=model.particles[part], log_weights=model.log_weights[part])
        for part in (~held_out, held_out)
    )
    return kept, judged


def randomised(model: Model, effects: tuple[str, ...], share: float = 0.5, seed: int = 0) -> Model:
    """The model with more effects, each of them present in a share of the particles.

    Args:
      model: gives everything else its distribution.
      effects: uses ("name" or "name:site") that the model does not have; where present, they follow their prior.
      share: of the particles in which an effect is present, each effect by itself; in the others its parameters have
        their null value, at which it does nothing.
      seed: of the draws.

    Raises:
      TrainingError: a share beyond 0 to 1, an effect that cannot be switched off, or one twice.
      SimError: an unknown effect, or one that the model has already.
    """
    if not 0.0 < share <= 1.0:
        raise TrainingError(describe("effect_share", share, "more than 0 and up to 1"))
    twice = sorted({effect for effect in effects if effects.count(effect) > 1})
    if twice:
        raise TrainingError(f"effect {', '.join(twice)} is named twice; name each once")
    if not effects:
        return model
    rng = np.random.default_rng([seed, 49979687])
    wide = model.with_particles(model.sample(rng, PARTICLES), randomised=list(effects))
    for effect in effects:
        known = len(wide.parameters)
        wide = wide.with_effect(effect)
        particles, absent = wide.particles.copy(), rng.random(PARTICLES) >= share
        added = wide.parameters[known:]
        particles[:, known:] = np.stack([p.sample(rng, PARTICLES) for p in added], axis=-1)  # another seed, other draws
        own = [p.null for p in added]
        if share < 1.0 and all(null is None for null in own):
            raise TrainingError(
                f"effect {effect} has no null value, so no episode can be without it; set the share to 1"
            )
        for column, null in enumerate(own, known):
            if null is not None:
                particles[absent, column] = null
        wide = dataclasses.replace(wide, particles=particles)
    return dataclasses.replace(wide, version=f"{model.saved_version}+{'+'.join(effects)}")
