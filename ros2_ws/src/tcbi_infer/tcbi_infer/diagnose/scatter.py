"""Scatter between servos of one make as linear nuisances."""

import numpy as np
from scipy.linalg import hadamard

from tcbi_infer.diagnose.fit import RADII, Fit, Fitter, Nuisance, slopes_step
from tcbi_infer.diagnose.problem import Problem
from tcbi_sim.model import JOINT_GAINS
from tcbi_sim.rigs import load_rig
from tcbi_sim.scatter import SCATTER, with_scatter

STEP = 2.0  # standard deviations, by which every gain is changed
NEAR = 0.05  # of a base parameter's range: slopes taken so near are as good as new ones
ROUNDS = 3  # of fits with slopes anew


def joint_scatter(problem: Problem, base: Fit, sets: np.ndarray, timestep: float) -> Nuisance:
    """How each joint's own gain changes the prediction, for one standard deviation; none for a rig with one joint.

    All gains are changed in every simulation, up or down by orthogonal columns (a weighing design: Plackett and Burman,
    The design of optimum multifactorial experiments, Biometrika 33, 1946), so that each slope is a mean over all
    simulations. Where feet stick and slip, predictions jump by more than one gain changes them: of one joint after the
    other the slopes were mostly these jumps.

    Args:
      problem: whose predictions these are.
      base: the fit around which to change gains.
      sets: the open ones.
      timestep: s, of fits with it.
    """
    model, joints = with_scatter(base.model)
    if not joints:
        return Nuisance.none(problem)
    signs = hadamard(1 << len(joints).bit_length())[:, 1 : len(joints) + 1].astype(float)
    gains = 1.0 + STEP * SCATTER * signs
    vectors = np.concatenate([np.tile(base.parameters, (len(signs), 1)), gains], axis=1)
    predicted = problem.replay.predict(model, vectors, list(sets), slopes_step(problem, timestep))
    effect = np.zeros((*problem.observed.shape, len(joints)))
    effect[sets] = slopes(signs, predicted) / STEP
    return Nuisance(effect, joints, base.unit)


def relinearised(problem: Problem, fit: Fit, sets: np.ndarray, timestep: float) -> Fit:
    """The fit carried on with the scatter's slopes from where it stands, until it stays near where they were taken.

    A base model without damping carries half the weight with soft servos; how a joint's gain changes its motion is not
    how it changes that of a fit with damping, which those slopes held back from the truth.
    """
    for _ in range(ROUNDS):
        shared = min(len(fit.scatter.at), len(fit.unit))
        moved = np.abs(fit.unit[:shared] - fit.scatter.at[:shared])
        if not (fit.scatter.names and fit.total < np.inf and moved.max() > NEAR):
            break
        scatter = joint_scatter(problem, fit, sets, timestep)
        fit = Fitter(problem, fit.model, scatter, sets, timestep).run(fit.unit[None], radii=RADII[-1:])
    return fit


def joint_gains(fit: Fit) -> tuple[float, ...]:
    """(J,) what a fit says of each joint's gain, over what its parameters say; its model may know gains already.

    Returns:
      () where neither says anything.
    """
    known = fit.model.joint_gains
    if not fit.scatter.names:
        return known
    joints = load_rig(fit.model.rig).joint_names
    own = dict(zip(fit.scatter.names, 1.0 + SCATTER * fit.nuisance, strict=True))
    known = known or (1.0,) * len(joints)
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
