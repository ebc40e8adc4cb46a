"""How much the demo records, simulates and trains: the full story, and a quick one."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Plan:
    """The demo's budget.

    Attributes:
      motions: gaits to learn from; each is recorded twice, so that the robot's own repeatability is known.
      unseen: gaits on which only the final errors are judged; each recorded twice, no fit ever sees them.
      motion_s: length of each recorded motion, s.
      deployments: rollouts of the task with the first policy, and again with the new one.
      deployment_s: length of each, s; 0 for the task's own.
      effects: candidates.
      thorough: whether the diagnosis takes its time.
      particles: of the inference.
      generations: of the inference, at most.
      training_s: wall time of the retraining.
    """

    motions: tuple[str, ...]
    unseen: tuple[str, ...]
    motion_s: float
    deployments: int
    deployment_s: float
    effects: tuple[str, ...]
    thorough: bool
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
    unseen=("steps:7", "sinus:7"),
    motion_s=4.0,
    deployments=3,
    deployment_s=0.0,
    effects=MORE_EFFECTS,
    thorough=True,
    particles=48,
    generations=4,
    training_s=60.0,
)
QUICK = Plan(
    motions=("steps", "sinus", "tripod", "squat"),
    unseen=("steps:7",),
    motion_s=2.6,
    deployments=2,
    deployment_s=3.0,
    effects=BASIC_EFFECTS,
    thorough=False,
    particles=16,
    generations=2,
    training_s=15.0,
)
