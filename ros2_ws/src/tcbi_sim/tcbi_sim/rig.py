"""A rig: a robot or a test bench, its joints and sensors, its own parameters, and how MuJoCo builds it.

Naming rules that everything relies on: an actuator bears its joint's name; sensors are `position/<joint>`, `attitude`,
`gyro`, `accelerometer`, `contact/<foot>` and `tracker`; a floating rig's feet are spheres, and it stands on the body
`ground`, of which `block_<i>` are the movable boxes.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import mujoco
import numpy as np

from tcbi_sim.errors import UnknownNameError
from tcbi_sim.fields import Fields
from tcbi_sim.parameter import Parameter

Values = dict[str, np.ndarray]  # parameter or constant name -> (B,)
FIRM_FRICTION = (0.999, 0.9995, 0.001, 0.5, 2.0)  # solimp_friction with which joints that stick do not creep


@dataclass(frozen=True)
class Noise:
    """Standard deviations of the sensors' white noise, and the encoder's step."""

    joint_position: float  # rad
    attitude: float = 0.0  # rad
    angular_velocity: float = 0.0  # rad/s
    linear_acceleration: float = 0.0  # m/s^2
    position: float = 0.0  # m
    encoder_step: float = 0.0  # rad


@dataclass(frozen=True, eq=False)
class Rig:
    """A robot or test bench and what is known of it before any data. Equal to itself alone, as its functions are."""

    name: str
    joint_names: tuple[str, ...]
    parameters: tuple[Parameter, ...]  # its own, whatever effects are added
    build: Callable[[int], mujoco.MjSpec]  # number of movable blocks -> a fresh spec
    apply: Callable[[Fields, Values, Values], None]  # writes parameters and constants into per-simulation fields
    noise: Noise
    foot_names: tuple[str, ...] = ()
    foot_geoms: tuple[str, ...] = ()  # each foot's sphere
    floating: bool = False  # stands free on the ground
    base: str = "base_link"  # the body with the free joint, if it is floating
    has_imu: bool = False
    own_quantities: frozenset[str] = frozenset()  # set by its parameters at every joint: as in PLACES, or back_emf
    has_torque_limit: bool = False  # of every servo or motor
    kind: str = "position"  # what a command is: a servo's position, or torque
    joint_range: float = np.pi  # rad, either side of zero
    speed_limit: float = 2 * np.pi  # rad/s, of a joint without load
    posture: tuple[float, ...] = ()  # rad, of each joint at rest; empty: zero
    stand_height: float = 0.0  # m, trunk above the ground in that posture
    contact_threshold: float = 0.0  # N
    rate: float = 50.0  # Hz, of its sensors
    groups: dict[str, tuple[str, ...]] = field(
        default_factory=dict
    )  # names for sets of joints, e.g. "coxa", "left middle leg"
    legs: dict[str, tuple[str, ...]] = field(default_factory=dict)  # leg -> its joints

    @property
    def at_rest(self) -> np.ndarray:
        """(J,) rad, the posture."""
        return np.array(self.posture) if self.posture else np.zeros(len(self.joint_names))

    def index(self, joint: str) -> int:
        """Position of a joint in the rig's order."""
        if joint not in self.joint_names:
            raise UnknownNameError("joint", joint, self.joint_names)
        return self.joint_names.index(joint)
