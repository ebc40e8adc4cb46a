"""Scatter between joints of one make, as linear nuisances: natural, so that no verdict may rest on it."""

import numpy as np

from tcbi_infer.diagnose.fit import Fit, Nuisance
from tcbi_infer.diagnose.problem import Problem
from tcbi_sim.rigs import load_rig

SCATTER = 0.03  # standard deviation of one servo's gain about its siblings', relative
STEP = 2.0  # standard deviations, of the finite difference


def joint_scatter(problem: Problem, base: Fit, sets: np.ndarray, timestep: float) -> Nuisance:
    """How each joint's own gain changes the prediction, for one standard deviation; none for a rig with one joint."""
    rig = load_rig(base.model.rig)
    taken = {use.partition(":")[2] for use in base.model.effects if use.startswith("gain_scatter:")}
    joints = [j for j in rig.joint_names if j not in taken]
    if len(rig.joint_names) < 2 or rig.kind != "position":
        return Nuisance.none(problem)
    model = base.model
    for joint in joints:
        model = model.with_effect(f"gain_scatter:{joint}")
    count = len(base.parameters)
    vectors = np.ones((len(joints) + 1, count + len(joints)))
    vectors[:, :count] = base.parameters
    vectors[np.arange(len(joints)), count + np.arange(len(joints))] = 1.0 + STEP * SCATTER
    predicted = problem.replay.predict(model, vectors, list(sets), timestep)
    effect = np.zeros((*problem.observed.shape, len(joints)))
    effect[sets] = np.moveaxis(np.nan_to_num(predicted[:-1] - predicted[-1]) / STEP, 0, -1)
    return Nuisance(effect, tuple(joints))
