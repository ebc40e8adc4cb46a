"""A model version as MJCF that plain MuJoCo loads, at its mean parameters.

What MuJoCo itself cannot hold (how commands travel, how readings leave) is named in a comment at the top.
"""

import dataclasses

import mujoco
import numpy as np

from tcbi_sim.engine import Simulator, edited_spec
from tcbi_sim.fields import CommandFields, SensingFields
from tcbi_sim.measurement import Scenario
from tcbi_sim.model import Model
from tcbi_sim.rigs import load_rig


def materialise(model: Model, parameters: np.ndarray | None = None) -> mujoco.MjModel:
    """The MjModel of one parameter vector (P,), the mean by default."""
    values = model.mean() if parameters is None else parameters
    simulator = Simulator(model, np.asarray(values)[None], [Scenario("none", 1.0, settle=0.0)], threads=1)
    return simulator.materialise()[0]


def to_xml(model: Model, parameters: np.ndarray | None = None) -> str:
    """Self-contained MJCF of one parameter vector (P,), the mean by default."""
    values = model.mean() if parameters is None else parameters
    rig = load_rig(model.rig)
    spec = edited_spec(rig, model.uses())
    spec.compile()
    _copy(materialise(model, values), spec)
    spec.compile()
    listed = "\n".join(f"  {p.name} = {v:.6g} {p.unit}" for p, v in zip(model.parameters, values, strict=True))
    listed += "".join(f"\n  {name} = {value:.6g} (fixed)" for name, value in model.fixed.items())
    left = outside(model)
    note = f"\n  Not in this file, since they act on commands or readings: {', '.join(left)}" if left else ""
    return f"<!-- {model.version} (rig {model.rig})\n{listed}{note}\n-->\n{spec.to_xml()}"


def outside(model: Model) -> list[str]:
    """Effects of a model that no MJCF holds, since they act on commands or readings."""
    return [u.key for u in model.uses() if _acts_outside(model, u.key)]


def _copy(model: mujoco.MjModel, spec: mujoco.MjSpec) -> None:
    """Write what effects may have changed back into the spec."""
    for body in spec.bodies[1:]:
        own = model.body(body.id)
        body.explicitinertial = True
        body.mass, body.ipos, body.iquat, body.inertia = own.mass[0], own.ipos, own.iquat, own.inertia
        body.fullinertia = [np.nan] * 6
        body.pos, body.quat = own.pos, own.quat
    for joint in spec.joints:
        own = model.joint(joint.id)
        if own.type[0] == mujoco.mjtJoint.mjJNT_FREE:
            continue
        dof = own.dofadr[0]
        joint.armature, joint.frictionloss = model.dof_armature[dof], model.dof_frictionloss[dof]
        joint.damping = [model.dof_damping[dof], *model.dof_dampingpoly[dof]][: len(joint.damping)]
        joint.stiffness = [own.stiffness[0], *([0.0] * (len(joint.stiffness) - 1))]
        joint.range = own.range
    for geom in spec.geoms:
        own = model.geom(geom.id)
        geom.friction, geom.solref, geom.solimp = own.friction, own.solref, own.solimp
        if own.type[0] == mujoco.mjtGeom.mjGEOM_BOX:
            geom.pos, geom.quat = own.pos, own.quat
    for site in spec.sites:
        site.pos = model.site(site.id).pos
    for tendon in spec.tendons:
        stiffness = model.tendon_stiffness[tendon.id]
        tendon.stiffness = [stiffness, *([0.0] * (len(tendon.stiffness) - 1))]
    for actuator in spec.actuators:
        own = model.actuator(actuator.id)
        actuator.gainprm, actuator.biasprm, actuator.forcerange = own.gainprm, own.biasprm, own.forcerange
        actuator.dynprm = own.dynprm
        if own.biasprm[2] > 0:  # MuJoCo would take it for a damping ratio where gain and bias are exactly opposite
            actuator.gainprm[0] *= 1 + 1e-5


def _acts_outside(model: Model, key: str) -> bool:
    """Whether an effect writes the command path or the sensors."""
    from tcbi_sim.effects import find_use

    rig = load_rig(model.rig)
    use = find_use(key, rig)
    names = {f.name for group in (CommandFields, SensingFields) for f in dataclasses.fields(group)} | {"compliance"}
    code = use.effect.apply.__code__
    return bool(names & set(code.co_names)) or use.effect.update is not None
