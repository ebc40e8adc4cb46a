"""Scatter between joints of one make, as linear nuisances: natural, so that no verdict may rest on it."""

import numpy as np
from scipy.linalg import hadamard

from tcbi_infer.diagnose.fit import Fit, Nuisance
from tcbi_infer.diagnose.problem import Problem
from tcbi_sim.model import JOINT_GAINS, Model
from tcbi_sim.rigs import load_rig

SCATTER = 0.03  # standard deviation of one servo's gain about its siblings', relative
STEP = 2.0  # standard deviations, by which every gain is changed


def joint_scatter(problem: Problem, base: Fit, sets: np.ndarray, timestep: float) -> Nuisance:
    """How each joint's own gain changes the prediction, for one standard deviation; none for a rig with one joint.

    All gains are changed in every simulation, up or down by orthogonal columns (a weighing design: Plackett and Burman,
    The design of optimum multifactorial experiments, Biometrika 33, 1946), so that each slope is a mean over all
    simulations. Where feet stick and slip, predictions jump by more than one gain changes them: of one joint after the
    other the slopes were mostly these jumps.
    """
    rig = load_rig(base.model.rig)
    taken = {use.partition(":")[2] for use in base.model.effects if use.startswith("gain_scatter:")}
    joints = [j for j in rig.joint_names if j not in taken]
    if len(rig.joint_names) < 2 or rig.kind != "position":
        return Nuisance.none(problem)
    model = base.model
    for joint in joints:
        model = model.with_effect(f"gain_scatter:{joint}")
    signs = hadamard(1 << len(joints).bit_length())[:, 1 : len(joints) + 1].astype(float)
    gains = 1.0 + STEP * SCATTER * signs
    vectors = np.concatenate([np.tile(base.parameters, (len(signs), 1)), gains], axis=1)
    predicted = problem.replay.predict(model, vectors, list(sets), timestep)
    effect = np.zeros((*problem.observed.shape, len(joints)))
    effect[sets] = slopes(signs, predicted) / STEP
    return Nuisance(effect, tuple(joints))


def joint_gains(model: Model, nuisance: Nuisance, delta: np.ndarray) -> tuple[float, ...]:
    """(J,) what a model with these nuisances says of each joint's gain, over what its parameters say; () if nothing.

    Args:
      model: that was fitted; it may know gains already.
      nuisance: of names (Q,).
      delta: (Q,) as fitted, in standard deviations.
    """
    if not nuisance.names:
        return model.joint_gains
    joints = load_rig(model.rig).joint_names
    own = dict(zip(nuisance.names, 1.0 + SCATTER * delta, strict=True))
    known = model.joint_gains or (1.0,) * len(joints)
    return tuple(float(np.clip(k * own.get(j, 1.0), *JOINT_GAINS)) for j, k in zip(joints, known, strict=True))


def slopes(signs: np.ndarray, predicted: np.ndarray) -> np.ndarray:
    """(..., Q) half of what the simulations differ by, on average, in which each of Q gains is up, and is down.

    What diverged (NaN) tells nothing, and stands at the mean of the others.

    Args:
      signs: (N, Q) of 1 and -1, orthogonal columns.
      predicted: (N, ...).
    """
    known = np.isfinite(predicted)
    mean = np.where(known, predicted, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    return np.moveaxis(np.tensordot(signs, np.where(known, predicted - mean, 0.0), axes=(0, 0)) / len(signs), 0, -1)
