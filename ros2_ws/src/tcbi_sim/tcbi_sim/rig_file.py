"""A rig that is described by files: a robot's own MJCF or URDF, and a short TOML beside it. docs/rigs.md explains it.

    rig = read_rig(Path("my_arm.toml"))     # raises RigFileError with everything that is wrong, at once

The model file stays as it is. What tcbi needs is added when it is read: a sensor for each joint, and a servo or motor
for each joint that has none.
"""

import dataclasses
import functools
import math
import tomllib
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from tcbi_sim.errors import SimError
from tcbi_sim.fields import Fields
from tcbi_sim.free_body import BODY_NOISE, FreeBody, read_free_body
from tcbi_sim.parameter import Parameter
from tcbi_sim.rig import FIRM_FRICTION, Noise, Rig, Values
from tcbi_sim.rig_settings import PLACES, Setting, write

NUMBERS = {  # key: default and what it must be
    "rate": (50.0, "Hz, above 0"),
    "joint_noise": (0.0005, "rad, 0 or more"),
    "encoder_step": (0.0, "rad, 0 or more"),
    "speed_limit": (2 * math.pi, "rad/s, above 0"),
}
TOP = {"model", "joints", "commands", "posture", "servo", "groups", "parameters", "constants", *NUMBERS}
TOP |= {"ground", "feet", "legs"}
SERVO = {"gain", "lag", "torque_limit"}
PARAMETER = {"sets", "factor", "unit", "low", "high", "nominal", "scale", "description"}
CONSTANT = {"sets", "factor", "default"}


class RigFileError(SimError):
    """A description that gives no rig.

    Args:
      path: the TOML file.
      faults: one line each.
    """

    def __init__(self, path: Path, faults: list[str]):
        self.path, self.faults = path, faults
        super().__init__(f"rig file {path}: {'; '.join(faults)}")


def read_rig(path: Path) -> Rig:
    """The rig that a TOML file describes, named as the file is.

    Raises:
      RigFileError: everything that is wrong with it or with the model that it names.
    """
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as e:
        raise RigFileError(path, [f"cannot be read ({e})"]) from e
    return _Reader(path, content).rig()


class _Reader:
    """Collects everything that is wrong, then raises once."""

    def __init__(self, path: Path, content: dict[str, Any]) -> None:
        self.path, self.content = path, content
        self.faults = [f"unknown key {key!r}" for key in sorted(set(content) - TOP)]

    def rig(self) -> Rig:
        spec = self._spec()
        numbers = {key: self._number(key) for key in NUMBERS}
        commands = self.content.get("commands", "position")
        if commands not in ("position", "torque"):
            self.faults.append(f"commands: got {commands!r}, allowed is position or torque")
        joints = self._joints(spec)
        servo = self._servo(spec, joints, commands)
        groups = self._groups(joints)
        body = read_free_body(self.content, spec, joints, self.faults.append)
        parameters = self._parameters(spec, joints)
        constants = self._constants(spec, joints)
        if "torque_limit" not in servo:
            self._torque_limits(spec, [*(s for _, s in parameters), *constants])
        if self.faults:
            raise RigFileError(self.path, self.faults)
        build = functools.partial(build_spec, self._model(), joints, commands, servo, body)
        try:
            model = build(0).compile()
        except ValueError as e:
            raise RigFileError(self.path, [f"MuJoCo refuses {self._model()}: {' '.join(str(e).split())}"]) from e
        posture = self._posture(joints)
        return Rig(
            name=self.path.stem,
            joint_names=joints,
            parameters=tuple(p for p, _ in parameters),
            build=build,
            apply=functools.partial(apply_settings, tuple(s for _, s in parameters), constants),
            noise=Noise(
                joint_position=numbers["joint_noise"],
                encoder_step=numbers["encoder_step"],
                **(BODY_NOISE if body else {}),
            ),
            own_quantities=set_everywhere([s for _, s in parameters], joints),
            has_torque_limit=all(bool(model.actuator(j).forcelimited[0]) for j in joints),
            kind=commands,
            joint_range=max(float(np.abs(model.joint(j).range).max()) or math.pi for j in joints),
            speed_limit=numbers["speed_limit"],
            rate=numbers["rate"],
            groups=groups,
            posture=tuple(posture.values()),
            **(body.of_rig(model, posture) if body else {}),
        )

    def _model(self) -> Path:
        return self.path.parent / str(self.content.get("model", ""))

    def _spec(self) -> mujoco.MjSpec:
        if not isinstance(self.content.get("model"), str) or not self._model().is_file():
            self.faults.append(f"model: got {self.content.get('model')!r}, allowed is an MJCF or URDF beside this file")
            raise RigFileError(self.path, self.faults)
        try:
            return mujoco.MjSpec.from_file(str(self._model()))
        except ValueError as e:
            self.faults.append(f"MuJoCo cannot read {self._model()}: {' '.join(str(e).split())}")
            raise RigFileError(self.path, self.faults) from e

    def _number(self, key: str) -> float:
        default, allowed = NUMBERS[key]
        value = self.content.get(key, default)
        if _is_number(value) and (value > 0 or (value == 0 and "or more" in allowed)):
            return float(value)
        self.faults.append(f"{key}: got {value!r}, allowed is a number ({allowed})")
        return default

    def _joints(self, spec: mujoco.MjSpec) -> tuple[str, ...]:
        hinges = [j.name for j in spec.joints if j.type == mujoco.mjtJoint.mjJNT_HINGE]
        joints = self.content.get("joints", hinges)
        if not isinstance(joints, list) or not joints or len({*map(str, joints)}) != len(joints):
            self.faults.append(f"joints: got {joints!r}, allowed is a list of different names")
            return ()
        missing = [j for j in joints if j not in hinges]
        if missing:
            self.faults.append(
                f"joints: the model has no hinge {', '.join(map(repr, missing))}; it has {', '.join(hinges)}"
            )
        if slashed := [j for j in joints if "/" in str(j)]:
            self.faults.append(f"joints: got {', '.join(map(repr, slashed))}, allowed are names without /; rename them")
        return tuple(j for j in joints if j in hinges)

    def _posture(self, joints: tuple[str, ...]) -> dict[str, float]:
        """Each joint's angle (rad): as listed, or in the key frame that is named, or in the model's first one."""
        model = mujoco.MjModel.from_xml_path(str(self._model()))
        keys = [model.key(k).name for k in range(model.nkey)]
        given = self.content.get("posture", keys[0] if keys else {})
        if isinstance(given, str) and given in keys:
            angles = model.key_qpos[keys.index(given)]
            return {joint: float(angles[model.joint(joint).qposadr[0]]) for joint in joints}
        if isinstance(given, dict) and set(given) <= set(joints) and all(map(_is_number, given.values())):
            return {joint: float(given.get(joint, 0.0)) for joint in joints}
        named = f"the name of a key frame of the model ({', '.join(filter(None, keys)) or 'none has one'})"
        fault = f"posture: got {given!r}, allowed is {named}, or a section with angles (rad) of the joints"
        raise RigFileError(self.path, [fault])

    def _servo(self, spec: mujoco.MjSpec, joints: tuple[str, ...], commands: str) -> dict[str, float]:
        servo = self.content.get("servo", {})
        wrong = not isinstance(servo, dict) or set(servo) - SERVO or not all(_is_number(v) for v in servo.values())
        if wrong or any(v <= 0 for v in servo.values()):
            self.faults.append(f"servo: got {servo!r}, allowed are numbers above 0 for {', '.join(sorted(SERVO))}")
            return {}
        for joint in joints:
            own = [a for a in spec.actuators if a.target == joint]
            if len(own) > 1:
                self.faults.append(f"joint {joint!r} has {len(own)} actuators in the model; leave one")
            elif own and (own[0].biastype == mujoco.mjtBias.mjBIAS_AFFINE) != (commands == "position"):
                self.faults.append(f"the model's actuator of {joint!r} takes no {commands} commands; change either")
            elif not own and commands == "position" and "gain" not in servo:
                self.faults.append(f"joint {joint!r} has no actuator in the model; give [servo] with gain (N m/rad)")
            elif own and not _replaces(servo, commands):
                self._own_actuator(joint, own[0], commands)
        return servo

    def _own_actuator(self, joint: str, actuator: mujoco.MjsActuator, commands: str) -> None:
        """Faults where an actuator that stays makes anything else of a command than the recording says."""
        whose = f"the model's actuator of {joint!r}"
        if actuator.gear[0] != 1:
            self.faults.append(
                f"{whose} has gear {actuator.gear[0]:g}, allowed is 1, since commands are of the joint; remove gear, "
                "and scale recordings of the motor's side in the mapping"
            )
        if commands == "torque" and actuator.gainprm[0] != 1:
            self.faults.append(
                f"{whose} has gainprm {actuator.gainprm[0]:g}, allowed is 1, since commands are in N m; make it a motor"
            )

    def _torque_limits(self, spec: mujoco.MjSpec, settings: list[Setting]) -> None:
        """Faults where a torque limit is to be set that no actuator has."""
        limited = {a.target for a in spec.actuators if _limited(a.forcelimited, a.forcerange)}
        for setting in settings:
            without = [j for j in setting.places if j not in limited]
            if setting.quantity == "torque_limit" and without:
                self.faults.append(
                    f"{setting.name}: {', '.join(map(repr, without))} has no torque limit in the model that could be "
                    "set; give [servo] with torque_limit (N m)"
                )

    def _groups(self, joints: tuple[str, ...]) -> dict[str, tuple[str, ...]]:
        groups = self.content.get("groups", {})
        if isinstance(groups, dict) and all(isinstance(g, list) and set(g) <= set(joints) for g in groups.values()):
            return {name: tuple(group) for name, group in groups.items()}
        self.faults.append(f"groups: got {groups!r}, allowed are lists of the joints")
        return {}

    def _parameters(self, spec: mujoco.MjSpec, joints: tuple[str, ...]) -> list[tuple[Parameter, Setting]]:
        found = []
        for name, section in self._sections("parameters"):
            setting = self._setting(f"parameters.{name}", name, section, PARAMETER, spec, joints)
            lacking = [key for key in ("unit", "low", "high", "nominal") if key not in section]
            if lacking:
                self.faults.append(f"parameters.{name} lacks {', '.join(lacking)}")
            if setting is None or lacking:
                continue
            own = {k: v for k, v in section.items() if k in {f.name for f in dataclasses.fields(Parameter)}}
            try:
                found.append((Parameter(name=name, **own), setting))
            except (SimError, TypeError) as e:
                self.faults.append(f"parameters.{name}: {e}")
        if not found and not self.faults:
            self.faults.append("parameters is empty; name one quantity at least that is not known exactly")
        return found

    def _constants(self, spec: mujoco.MjSpec, joints: tuple[str, ...]) -> tuple[Setting, ...]:
        found = []
        for name, section in self._sections("constants"):
            setting = self._setting(f"constants.{name}", name, section, CONSTANT, spec, joints)
            default = section.get("default")
            if default is not None and not _is_number(default):
                self.faults.append(f"constants.{name}.default: got {default!r}, allowed is a number")
            elif setting is not None:
                found.append(dataclasses.replace(setting, default=math.nan if default is None else float(default)))
        return tuple(found)

    def _sections(self, key: str) -> list[tuple[str, dict[str, Any]]]:
        sections = self.content.get(key, {})
        if not isinstance(sections, dict) or not all(isinstance(s, dict) for s in sections.values()):
            self.faults.append(f"{key}: got {sections!r}, allowed are sections [{key}.NAME]")
            return []
        return list(sections.items())

    def _setting(
        self,
        where: str,
        name: str,
        section: dict[str, Any],
        keys: set[str],
        spec: mujoco.MjSpec,
        joints: tuple[str, ...],
    ) -> Setting | None:
        sets = section.get("sets", name)
        if sets not in PLACES:
            self.faults.append(f"{where}.sets: got {sets!r}, allowed is one of {', '.join(PLACES)}")
            return None
        kind = PLACES[sets]
        self.faults += [f"{where}: unknown key {k!r}" for k in sorted(set(section) - keys - {kind})]
        known = {
            "joints": joints,
            "bodies": tuple(b.name for b in spec.bodies[1:]),
            "geoms": ("ground", *(g.name for g in spec.geoms if g.name)),
        }[kind]
        places = section.get(kind, list(joints) if kind == "joints" else None)
        if not isinstance(places, list) or not places or not set(places) <= set(known):
            self.faults.append(f"{where}.{kind}: got {places!r}, allowed is a list out of {', '.join(known)}")
            return None
        return Setting(name, sets, tuple(places), bool(section.get("factor", False)))


def _limited(flag: int, ends: np.ndarray) -> bool:
    """Whether a limit of an actuator counts: as it says, or by its ends where it says nothing."""
    return bool(ends[0] < ends[1] if flag == mujoco.mjtLimited.mjLIMITED_AUTO else flag)


def _replaces(servo: dict[str, float], commands: str) -> bool:
    """Whether [servo] takes the place of the model's own actuators."""
    return commands == "position" and "gain" in servo


def set_everywhere(settings: list[Setting], joints: tuple[str, ...]) -> frozenset[str]:
    """The quantities that settings, taken together, set at every joint."""
    places = {q: {p for s in settings if s.quantity == q for p in s.places} for q in PLACES}
    return frozenset(q for q, kind in PLACES.items() if kind == "joints" and set(joints) <= places[q])


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def build_spec(
    model: Path,
    joints: tuple[str, ...],
    commands: str,
    servo: dict[str, float],
    body: FreeBody | None = None,
    blocks: int = 0,
) -> mujoco.MjSpec:
    """A fresh spec of a model file, with actuators that bear their joints' names and a sensor for each joint."""
    spec = mujoco.MjSpec.from_file(str(model))
    for sensor in list(spec.sensors):  # their names could be those of tcbi's own
        spec.delete(sensor)
    if body:
        body.add_to(spec, blocks)
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    for key in list(spec.keys):  # effects may add joints, which a key frame of the old size would not fit
        spec.delete(key)
    for name in joints:
        spec.joint(name).solimp_friction = list(FIRM_FRICTION)
        own = [a for a in spec.actuators if a.target == name]
        actuator = own[0] if own else spec.add_actuator(target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.name = name
        if _replaces(servo, commands):
            actuator.set_to_position(kp=servo["gain"], kv=servo["gain"] * servo.get("lag", 0.0))
            actuator.gear, actuator.ctrllimited = [1, 0, 0, 0, 0, 0], False
        elif not own:
            actuator.set_to_motor()
        if "torque_limit" in servo:
            actuator.forcelimited = True
            actuator.forcerange = [-servo["torque_limit"], servo["torque_limit"]]
        spec.add_sensor(
            name=f"position/{name}",
            type=mujoco.mjtSensor.mjSENS_JOINTPOS,
            objtype=mujoco.mjtObj.mjOBJ_JOINT,
            objname=name,
        )
    return spec


def apply_settings(
    parameters: tuple[Setting, ...], known: tuple[Setting, ...], fields: Fields, values: Values, constants: Values
) -> None:
    """Write a recording's constants, then the parameters."""
    for setting in known:
        given = constants.get(setting.name, np.full(fields.count, np.nan))
        value = np.where(np.isnan(given), setting.default, given)
        if not np.isnan(value).all():
            write(fields, setting, value)
    for setting in parameters:
        write(fields, setting, values[setting.name])
