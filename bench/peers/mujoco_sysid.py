"""mujoco.sysid on the recordings of `real_data.py`: what it can express of each model, fitted to the same data.

It fits parameters of a MuJoCo model that the user has chosen, from one start, by least squares. It does not say which
effect is missing, cannot switch a servo's power off in the middle of a recording, and has no friction that grows
with the load.
"""

import contextlib
import sys
import time
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
from mujoco import sysid

from tcbi_infer.importer import read_log, read_rollouts
from tcbi_infer.mapping import load_mapping
from tcbi_infer.pieces import pieces
from tcbi_sim.measurement import Measurement
from tcbi_sim.rigs import load_rig

Modifier = Callable[[mujoco.MjSpec, float], None]
Bounds = tuple[float, float, float]  # nominal, low, high


def sequences(m: Measurement, spec: mujoco.MjSpec) -> sysid.ModelSequences:
    """One recording for mujoco.sysid, its commands held between their times."""
    model = spec.compile()
    end = powered(m)
    grid = np.arange(0.0, end, model.opt.timestep)
    newest = np.clip(np.searchsorted(m.commands.time, grid, side="right") - 1, 0, None)
    velocity = np.array(m.scenario.initial_joint_velocity or np.zeros(model.nv))
    start = sysid.create_initial_state(model, m.joint_position[0].copy(), velocity)
    inside = m.time <= grid[-1]
    measured = sysid.TimeSeries.from_names(m.time[inside], m.joint_position[inside], model)
    return sysid.ModelSequences(
        m.rollout_id, spec, "all", start, sysid.TimeSeries(grid, m.commands.target[newest]), measured
    )


def powered(m: Measurement) -> float:
    """Until when (s) the servos have power."""
    on = m.commands.torque_on
    off = np.flatnonzero(~on) if on is not None else np.array([], int)
    return float(m.commands.time[off[0]]) if off.size else m.scenario.duration


def fit(
    seen: list[sysid.ModelSequences], unseen: list[sysid.ModelSequences], known: dict[str, tuple[Bounds, Modifier]]
) -> tuple[dict[str, float], np.ndarray, float]:
    """Fitted values, error (J,) in deg on what was not fitted, and the processor time (s) of the fit."""
    parameters = sysid.ParameterDict()
    for name, ((nominal, low, high), modify) in known.items():
        change = lambda spec, p, modify=modify: modify(spec, float(p.value[0]))  # noqa: E731
        parameters.add(sysid.Parameter(name, nominal, low, high, modifier=change))
    began = time.process_time()
    with contextlib.redirect_stdout(sys.stderr):  # its optimiser prints its iterations, and stdout is for figures
        residual = sysid.build_residual_fn(models_sequences=seen, n_threads=1)
        found, _ = sysid.optimize(parameters, residual, verbose=False)
    seconds = time.process_time() - began
    judge = sysid.build_residual_fn(models_sequences=unseen, n_threads=1)
    _, predicted, measured = judge(found.as_vector(), found)
    pairs = zip([p for group in predicted for p in group], [m for group in measured for m in group], strict=True)
    error = np.concatenate([p.data - m.data for p, m in pairs])
    values = {name: float(found[name].value[0]) for name in known}
    return values, np.degrees(np.sqrt(np.mean(error**2, axis=0))), seconds


def compare(data: Path) -> list[tuple[str, float, str]]:
    """Name, value and unit of each figure."""
    return [*pendulum(data), *arm(data), *double_pendulum(data)]


def _told(name: str, error: float, seconds: float, *more: tuple[str, float, str]) -> list[tuple[str, float, str]]:
    return [(f"sysid, {name}", error, "deg"), *more, (f"sysid, {name}: time of the fit", seconds, "s")]


def _position_gain(spec: mujoco.MjSpec, name: str, gain: float, lag: float = 0.0) -> None:
    spec.actuator(name).set_to_position(kp=gain, kv=gain * lag)


def pendulum(data: Path) -> list[tuple[str, float, str]]:
    """The base model of the servo bench, judged on sin_time_square, where the servo always has power."""
    mapping, rig = load_mapping("xl330_bench"), load_rig("motor_bench")
    seen, unseen = [], []
    for path in sorted((data / "xl330_pendulum").glob("*.json")):
        m, spec = read_log(mapping, path), rig.build(0)
        spec.modelname = str(m.scenario.constant("kp"))
        (unseen if m.rollout_id.endswith("sin_time_square") else seen).append(sequences(m, spec))
    known: dict[str, tuple[Bounds, Modifier]] = {
        "gain": ((4e-3, 2e-4, 5e-2), lambda s, v: _position_gain(s, "servo", v * float(s.modelname))),
        "damping": ((0.04, 1e-3, 0.3), lambda s, v: setattr(s.joint("servo"), "damping", [v, 0, 0])),
        "friction": ((0.02, 1e-3, 0.2), lambda s, v: setattr(s.joint("servo"), "frictionloss", v)),
        "stall_torque": (
            (0.77, 0.2, 1.2),
            lambda s, v: setattr(s.actuator("servo"), "forcerange", [-v, v]),
        ),
    }
    _, error, seconds = fit(seen, unseen, known)
    return _told("xl330: sin_time_square held out", error[0], seconds)


def arm(data: Path) -> list[tuple[str, float, str]]:
    """The arm with a stiffness and Coulomb friction for its elbow, and one lag."""
    mapping, rig = load_mapping("so101_arm"), load_rig("so101_arm")
    chosen = ("static_holding", "velocity_ramp", "chirp_sweep", "backlash_detection")
    seen, unseen = [], []
    for path in sorted(p for p in (data / "so101_arm").iterdir() if p.is_dir()):
        log = read_log(mapping, path)
        used = [p for p in pieces(log, 15.0)[2::4]] if path.name in chosen else [log]
        for m in used:
            spec = rig.build(0)
            spec.option.timestep = 0.005
            (seen if path.name in chosen else unseen).append(sequences(m, spec))

    def lag(spec: mujoco.MjSpec, value: float) -> None:
        for joint in rig.joint_names:
            _position_gain(spec, joint, spec.actuator(joint).gainprm[0], value)

    def elbow(spec: mujoco.MjSpec, value: float) -> None:
        old = spec.actuator("Elbow")
        _position_gain(spec, "Elbow", value, -old.biasprm[2] / old.gainprm[0])

    known: dict[str, tuple[Bounds, Modifier]] = {
        "lag": ((0.08, 0.01, 0.3), lag),
        "gain": ((12.0, 3.0, 100.0), elbow),
        "friction": ((0.05, 0.0, 0.5), lambda s, v: setattr(s.joint("Elbow"), "frictionloss", v)),
    }
    values, error, seconds = fit(seen, unseen, known)
    gain = ("sysid, so101: the elbow's stiffness", values["gain"], "N m/rad")
    return _told("so101: elbow", error[rig.index("Elbow")], seconds, gain)


def double_pendulum(data: Path) -> list[tuple[str, float, str]]:
    """Two masses, rotor inertia, and one Coulomb friction."""
    mapping, rig = load_mapping("double_pendulum"), load_rig("double_pendulum")
    logs = sorted((data / "double_pendulum").glob("*.csv.gz"))
    seen, unseen = [], []
    for k, log in enumerate(logs):
        for m in read_rollouts(mapping, log):
            (unseen if k in (1, 3) else seen).append(sequences(m, rig.build(0)))

    def joints(field: str) -> Modifier:
        def modify(spec: mujoco.MjSpec, value: float) -> None:
            for joint in rig.joint_names:
                setattr(spec.joint(joint), field, value)

        return modify

    known: dict[str, tuple[Bounds, Modifier]] = {
        "mass_1": ((0.56, 0.3, 0.9), lambda s, v: setattr(s.body("link_1"), "mass", v)),
        "mass_2": ((0.60, 0.3, 0.9), lambda s, v: setattr(s.body("link_2"), "mass", v)),
        "friction": ((0.03, 0.0, 0.15), joints("frictionloss")),
        "inertia": ((0.003, 0.0, 0.02), joints("armature")),
    }
    values, error, seconds = fit(seen, unseen, known)
    friction = ("sysid, double pendulum: Coulomb friction", values["friction"], "N m")
    return _told("double pendulum, both joints", float(np.sqrt(np.mean(error**2))), seconds, friction)
