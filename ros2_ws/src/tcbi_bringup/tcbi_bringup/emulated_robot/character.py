"""What this one robot is like: the plain parameters, which no drawing tells, drawn from its seed."""

from dataclasses import dataclass

import numpy as np

from tcbi_bringup.emulated_robot.errors import EmulatedRobotError

JOINT_COUNT, FOOT_COUNT = 18, 6
FRICTION = (0.55, 0.95)  # inside 0.5-1 of the paper's Table 1
MASS = (0.6, 1.0)  # kg, inside 0.4-1.2
GAIN = (1.5, 5.0)  # N m/rad, inside 0.1-8, drawn on a log scale
TURNING = (0.002, 0.004)  # m, how the patch of a rubber cap grips a foot that turns on the spot
GAIN_SCATTER = 0.03  # between the servos of one robot
SWITCH_SCATTER = 0.1  # between the foot switches' thresholds


@dataclass(frozen=True)
class Character:
    """The truth about one robot, hidden effects apart.

    Attributes:
      friction: coefficient between foot and ground.
      mass: kg, of the whole robot without payload.
      gain: N m/rad, the median servo.
      gain_factor: (18,) each servo's gain over the median one's.
      switch_factor: (6,) each foot switch's threshold over the drawing's.
      turning: m, the torque with which a foot resists turning on the spot over its load.
    """

    seed: int
    friction: float
    mass: float
    gain: float
    gain_factor: np.ndarray
    switch_factor: np.ndarray
    turning: float


def draw(seed: int) -> Character:
    """The character of robot number `seed` (0 or more); same seed, same robot.

    Raises:
      EmulatedRobotError: a negative seed.
    """
    if seed < 0:
        raise EmulatedRobotError(f"a robot's seed is 0 or more, got {seed}")
    rng = np.random.default_rng([seed, 1])
    return Character(
        seed=seed,
        friction=rng.uniform(*FRICTION),
        mass=rng.uniform(*MASS),
        gain=float(np.exp(rng.uniform(*np.log(GAIN)))),
        gain_factor=np.exp(rng.normal(0.0, GAIN_SCATTER, JOINT_COUNT)),
        switch_factor=np.exp(rng.normal(0.0, SWITCH_SCATTER, FOOT_COUNT)),
        turning=rng.uniform(*TURNING),
    )
