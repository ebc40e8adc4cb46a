"""What the emulated firmware asks of the physics behind it.

The firmware calls a body from one thread only. A body brings itself up to the present (its own clock, real time) in
`read`, which the port loop calls at least 50 times a second; a goal or a torque switch acts from that present on.
Joints are counted in the contract's order (`tcbi_contract.names.JOINTS`), zero at the neutral stance, in rad. Servo
steps, directions and zero offsets are the firmware's business.

    state = body.read()
    body.write_goal(0, 0.1, duration_s=0.2)
    body.set_torque(0, True)
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np


@dataclass(frozen=True)
class BodyState:
    """What the robot's sensors say at one instant, before the wire quantises it.

    Attributes:
      time_s: the robot's own clock since it was switched on; never goes back.
      joint_position: (18,) rad.
      voltage: V at the servos.
      temperature: (18,) degrees Celsius.
      load: (18,) share of the servo's greatest torque, -1 to 1.
      attitude: (4,) base in world, x y z w.
      angular_velocity: (3,) rad/s in `imu_link`.
      linear_acceleration: (3,) m/s^2 with gravity in `imu_link`.
      contact: (6,) bool, leg order of the contract.
    """

    time_s: float
    joint_position: np.ndarray
    voltage: float
    temperature: np.ndarray
    load: np.ndarray
    attitude: np.ndarray
    angular_velocity: np.ndarray
    linear_acceleration: np.ndarray
    contact: np.ndarray


class Body(Protocol):
    """A robot without its electronics."""

    def write_goal(self, servo_index: int, goal_rad: float, duration_s: float, speed_rad_s: float = 0.0) -> None:
        """Move one joint linearly from its last commanded position to `goal_rad`.

        Args:
          servo_index: 0 to 17, place of the joint in the contract's order.
          goal_rad: target.
          duration_s: time of the move; 0 means that `speed_rad_s` decides.
          speed_rad_s: speed of the move where `duration_s` is 0; 0 for both means as fast as the servo can.

        After the torque has been off, the last commanded position is where the joint was when the torque came on.
        """

    def set_torque(self, servo_index: int, on: bool) -> None:
        """Switch one servo's torque. When it comes on, the servo holds where it is, until the next goal."""

    def read(self) -> BodyState:
        """The sensors, now."""
