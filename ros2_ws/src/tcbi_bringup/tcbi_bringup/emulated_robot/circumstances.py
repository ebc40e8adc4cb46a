"""What no experimenter can repeat: how the robot was put down, what the battery gives just now, the dust on its feet.

A real robot that repeats a motion differs from itself by more than its sensors' noise. These are drawn anew each time
the robot is put down; their sizes are those of careful work on a bench.
"""

from dataclasses import dataclass

import numpy as np

YAW = 0.01  # rad, of putting the robot down by eye along a line
TILT = 0.002  # rad, of a board that is set with a digital inclinometer
FRICTION = 0.03  # of the coefficient: dust, another spot of the board
SUPPLY = 0.01  # of the servos' stiffness: the battery's state of charge


@dataclass(frozen=True)
class Circumstances:
    """One putting down of the robot."""

    yaw: float  # rad, added to the heading
    slope_roll: float  # rad, added to the ground's
    slope_pitch: float  # rad
    friction_factor: float
    supply_factor: float

    @staticmethod
    def draw(rng: np.random.Generator) -> "Circumstances":
        """New ones."""
        yaw, roll, pitch, friction, supply = rng.standard_normal(5)
        return Circumstances(
            YAW * yaw,
            TILT * roll,
            TILT * pitch,
            float(np.exp(FRICTION * friction)),
            float(np.exp(SUPPLY * supply)),
        )
