"""What one connection has read: readings for the topics, health for the diagnostics. Pure data."""

from dataclasses import dataclass, field

from hexapod_driver.sensor_board import Sample


@dataclass(frozen=True)
class JointReading:
    """All joints at once: ROS stamp in ns, (18,) rad."""

    stamp_ns: int
    position: tuple[float, ...]


@dataclass(frozen=True)
class BoardReading:
    """One sample of the sensor board: ROS stamp in ns, the sample."""

    stamp_ns: int
    sample: Sample


Reading = JointReading | BoardReading


@dataclass
class Health:
    """What diagnostics tell about one connection. Keys of the dictionaries are servo ids.

    Attributes:
      torque: as read back since the robot was last told to be limp.
      unconfirmed: servos of a limp robot that have not said in time that their torque is off.
    """

    voltage: dict[int, float] = field(default_factory=dict)
    temperature: dict[int, int] = field(default_factory=dict)
    errors: dict[int, int] = field(default_factory=dict)
    torque: dict[int, bool] = field(default_factory=dict)
    unconfirmed: tuple[int, ...] = ()
    incomplete_reads: int = 0
    silent_servos: tuple[int, ...] = ()
    joint_readings: int = 0
    board_samples: int = 0
    limited_commands: int = 0
    skipped_questions: int = 0
