"""A quadruped of two joints a leg: its model file, its description, and logs of it that plain MuJoCo simulates."""

import csv
from pathlib import Path

import mujoco
import numpy as np

LEGS = {"fl": (1, 1), "fr": (1, -1), "rl": (-1, 1), "rr": (-1, -1)}
JOINTS = tuple(f"{leg}_{joint}" for leg in LEGS for joint in ("hip", "knee"))
RATE = 100  # Hz
POSTURE = np.tile([0.6, -1.2], 4)  # rad

DESCRIPTION = f"""
model = "quadruped.xml"
rate = {RATE}
joint_noise = 0.001
[ground]
imu = "imu"
sliding_friction = 0.7
[feet]
{"".join(f'{leg} = "{leg}_foot"{chr(10)}' for leg in LEGS)}
[legs]
{"".join(f'{leg} = ["{leg}_hip", "{leg}_knee"]{chr(10)}' for leg in LEGS)}
[parameters.trunk]
sets = "mass"
bodies = ["trunk"]
unit = "kg"
low = 0.5
high = 2.0
nominal = 1.0
scale = "log"
[parameters.gain]
unit = "N m/rad"
low = 4.0
high = 40.0
nominal = 12.0
scale = "log"
[parameters.friction]
sets = "sliding_friction"
geoms = ["ground"]
unit = "1"
low = 0.3
high = 1.2
nominal = 0.7
"""

MAPPING = f"""
rig = "quadruped"
joints = {list(JOINTS)}
source = "robot"
[position]
columns = {[f"q_{j}" for j in JOINTS]}
[command]
columns = {[f"c_{j}" for j in JOINTS]}
[attitude]
columns = ["x", "y", "z", "w"]
order = "xyzw"
[angular_velocity]
columns = ["wx", "wy", "wz"]
unit = "deg/s"
[linear_acceleration]
columns = ["ax", "ay", "az"]
[contact]
columns = {list(LEGS)}
threshold = 1.0
unit = "N"
"""


def mjcf(trunk: float = 1.0, friction: float = 0.7, gain: float = 12.0, weak: float = 1.0) -> str:
    """The robot.

    Args:
      trunk: kg.
      friction: between feet and floor.
      gain: N m/rad.
      weak: share of the gain that the rear left leg has.
    """
    legs = "".join(
        f"""<body name="{leg}_thigh" pos="{0.11 * front} {0.1 * left} 0">
          <joint name="{leg}_hip" axis="0 1 0" range="-1.5 1.5" damping="0.05" armature="0.002"/>
          <geom type="capsule" fromto="0 0 0 0 0 -0.1" size="0.012" mass="0.08"/>
          <body name="{leg}_shank" pos="0 0 -0.1">
            <joint name="{leg}_knee" axis="0 1 0" range="-2.4 0.2" damping="0.05" armature="0.002"/>
            <geom type="capsule" fromto="0 0 0 0 0 -0.1" size="0.009" mass="0.04"/>
            <geom name="{leg}_foot" type="sphere" pos="0 0 -0.1" size="0.014" mass="0.01"/>
          </body>
        </body>"""
        for leg, (front, left) in LEGS.items()
    )
    gains = {j: gain * (weak if j.startswith("rl") else 1.0) for j in JOINTS}
    servos = "".join(f'<position name="{j}" joint="{j}" kp="{g}" forcerange="-3 3"/>' for j, g in gains.items())
    return f"""<mujoco model="quadruped">
      <compiler angle="radian"/>
      <option timestep="0.0005" cone="elliptic"/>
      <worldbody>
        <geom name="floor" type="plane" size="5 5 0.1" friction="{friction} 0.005 0.0001" priority="1" solref="0.01 1"/>
        <body name="trunk" pos="0 0 0.25">
          <freejoint/>
          <geom type="box" size="0.13 0.05 0.03" mass="{trunk}"/>
          <site name="imu" pos="0.02 0 0.01"/>{legs}
        </body>
      </worldbody>
      <actuator>{servos}</actuator>
      <sensor><accelerometer name="accelerometer" site="imu"/><gyro name="gyro" site="imu"/></sensor>
    </mujoco>"""


def motions(seconds: float) -> dict[str, np.ndarray]:
    """Targets (T, 8) rad at RATE by name; each begins in the posture."""
    t = np.arange(round(seconds * RATE)) / RATE
    bend = np.repeat(np.eye(4), 2, axis=0).T * np.tile([1.0, -2.0], 4)  # of each leg: the knee twice as far as the hip

    def legs(hertz: float, phases: list[float], size: float = 0.18) -> np.ndarray:
        return size * np.sin(2 * np.pi * hertz * t[:, None] + np.array(phases)) @ bend

    lifted = 0.03 * np.sign(np.sin(np.pi * t))[:, None] * np.array([1.0, -1.0, -1.0, 1.0]) @ bend
    hips = 0.15 * np.sin(2 * np.pi * 0.6 * t)[:, None] * np.tile([1.0, 0.3], 4)
    knots = np.random.default_rng(3).uniform(-0.07, 0.07, (4, 12))
    drawn = np.stack([np.interp(t, np.linspace(0, seconds, 12), k) for k in knots], axis=1) @ bend
    half, quarter = np.pi, np.pi / 2
    found = {
        "squat": legs(0.7, [0, 0, 0, 0]),
        "roll": legs(0.6, [0, half, 0, half], 0.07),
        "pitch": legs(0.8, [0, 0, half, half]),
        "twist": legs(0.6, [0, quarter, half, half + quarter], 0.07),
        "drawn": drawn,
        "steps": lifted,
        "sway": hips,
    }
    return {name: POSTURE + np.clip(t / 0.5, 0, 1)[:, None] * moved for name, moved in found.items()}


def write_log(path: Path, xml: str, targets: np.ndarray, seed: int, yaw: float = 0.0) -> None:
    """Simulate a robot, from rest, and write what its sensors say of a motion.

    Args:
      path: of the CSV.
      xml: the robot's MJCF.
      targets: (T, 8) rad at RATE.
      seed: of the sensors' noise, and of how the robot is put down.
      yaw: rad, that it heads to.
    """
    model = mujoco.MjModel.from_xml_string(xml)
    data, rng = mujoco.MjData(model), np.random.default_rng(seed)
    joints = [model.joint(name).qposadr[0] for name in JOINTS]
    feet = [model.geom(f"{leg}_foot").id for leg in LEGS]
    data.ctrl[:] = targets[0]
    data.qpos[joints] = targets[0] + rng.normal(0, 0.03, len(joints))  # put down otherwise each time
    data.qpos[2:7] = [0.2, np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]
    steps, rows = round(1 / RATE / model.opt.timestep), []
    mujoco.mj_step(model, data, nstep=2 * RATE * steps)
    for k, target in enumerate(targets):
        mujoco.mj_forward(model, data)
        turned = np.empty(4)
        mujoco.mju_mat2Quat(turned, data.site("imu").xmat)
        turned = np.roll(turned + rng.normal(0, 0.001, 4), -1)
        rates = np.degrees(data.sensor("gyro").data + rng.normal(0, 0.01, 3))
        felt = data.sensor("accelerometer").data + rng.normal(0, 0.05, 3)
        angles = data.qpos[joints] + rng.normal(0, 0.001, len(joints))
        rows.append([k / RATE, *angles, *target, *turned, *rates, *felt, *_pressed(model, data, feet)])
        data.ctrl[:] = target
        mujoco.mj_step(model, data, nstep=steps)
    names = ["x", "y", "z", "w", "wx", "wy", "wz", "ax", "ay", "az", *LEGS]
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([["time", *(f"{s}_{j}" for s in "qc" for j in JOINTS), *names], *rows])


def _pressed(model: mujoco.MjModel, data: mujoco.MjData, feet: list[int]) -> np.ndarray:
    """(4,) N that the floor bears each foot with."""
    force, found = np.zeros(6), np.zeros(len(feet))
    for c in range(data.ncon):
        mujoco.mj_contactForce(model, data, c, force)
        found += force[0] * np.isin(feet, data.contact[c].geom)
    return found
