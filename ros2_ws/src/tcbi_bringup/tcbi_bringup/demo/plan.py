"""How much the demo records, simulates and trains: the full story, and a quick one."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from tcbi_infer.diagnose.settings import QUICK as QUICK_DIAGNOSIS
from tcbi_infer.diagnose.settings import Settings

SLOPE = 0.12  # rad, of the ground under the recorded motions
TURN = 2.4  # rad between the directions in which it falls, so that no two are alike


@dataclass(frozen=True)
class Plan:
    """The demo's budget.

    Attributes:
      motions: gaits to learn from.
      repeated: the first so many of them are recorded twice, so that the robot's own repeatability is known.
      unseen: gaits on which only the final errors are judged, each recorded twice; no fit ever sees them.
      motion_s: length of each recorded motion, s.
      deployments: rollouts of the task with the first policy, and again with the new one.
      deployment_s: length of each, s; 0 for the task's own.
      effects: candidates.
      settings: of the diagnosis.
      bands: particles of the predictive bands in comparisons.
      particles: of the inference.
      generations: of the inference, at most.
      training_s: wall time of the retraining.
    """

    motions: tuple[str, ...]
    repeated: int
    unseen: tuple[str, ...]
    motion_s: float
    deployments: int
    deployment_s: float
    effects: tuple[str, ...]
    settings: Settings
    bands: int
    particles: int
    generations: int
    training_s: float


# the six that the quick story tells apart; a leg for each site
BASIC_EFFECTS = (
    "coulomb_friction",
    "viscous_damping",
    "command_latency",
    "backlash",
    "payload",
    *(f"weak_leg:{leg}" for leg in ("lf", "lm", "lr", "rf", "rm", "rr")),
)

# without those of single joints and those that follow the load from sample to sample, which take long on 18 joints
MORE_EFFECTS = (
    *BASIC_EFFECTS,
    *("command_deadband", "gyro_bias", "imu_tilt", "lost_commands", "rotor_inertia", "sensor_latency", "slope_error"),
    *("soft_ground", "torque_saturation"),
)

FULL = Plan(
    motions=("steps", "sinus", "tripod", "squat", "steps:1", "twist", "dither", "sinus:1"),
    repeated=8,
    unseen=("steps:7", "sinus:7"),
    motion_s=4.0,
    deployments=3,
    deployment_s=0.0,
    effects=MORE_EFFECTS,
    settings=Settings(),
    bands=12,
    particles=48,
    generations=4,
    training_s=60.0,
)
QUICK = Plan(
    motions=("steps", "tripod", "sinus", "squat", "dither"),  # the fewest kinds that a false-alarm rate can rest on
    repeated=2,  # feet that move do not do twice the same, so one that walks is among them
    unseen=("steps:7",),
    motion_s=2.2,
    deployments=2,
    deployment_s=2.0,
    effects=(*BASIC_EFFECTS, "lost_commands"),  # no simulation of it: repeats tell it
    settings=replace(QUICK_DIAGNOSIS, rivals=False),  # few candidates, none alike
    bands=8,
    particles=48,
    generations=2,
    training_s=10.0,
)


class Recording(NamedTuple):
    """One rollout of a motion."""

    motion: int  # its number
    gait: str
    trial: int  # 1 is the repetition


def recordings(gaits: tuple[str, ...], repeated: int) -> list[Recording]:
    """What to record: every motion, the first ones twice."""
    return [Recording(i, gait, trial) for i, gait in enumerate(gaits) for trial in range(2 if i < repeated else 1)]


def slope_of(motion: int) -> tuple[float, float]:
    """Roll and pitch of the ground in rad under a motion: each one's falls another way."""
    return SLOPE * float(np.cos(TURN * motion)), SLOPE * float(np.sin(TURN * motion))
