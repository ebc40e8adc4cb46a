"""Scatter between servos of one make: natural, so that no verdict may rest on it."""

from tcbi_sim.model import Model
from tcbi_sim.rigs import load_rig

SCATTER = 0.03  # standard deviation of one servo's gain about its siblings', relative
EFFECT = "gain_scatter"


def with_scatter(model: Model) -> tuple[Model, tuple[str, ...]]:
    """The model with each servo's own gain as a parameter (1 where it is like its siblings), and their joints.

    Joints whose gain is a parameter already are left out, and all of a rig that has one joint or no servos.
    """
    rig = load_rig(model.rig)
    if len(rig.joint_names) < 2 or rig.kind != "position":
        return model, ()
    joints = tuple(joint for joint in rig.joint_names if f"{EFFECT}:{joint}" not in model.effects)
    for joint in joints:
        model = model.with_effect(f"{EFFECT}:{joint}")
    return model, joints
