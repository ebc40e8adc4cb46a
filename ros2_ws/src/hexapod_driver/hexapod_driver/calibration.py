"""From joints in rad to servo steps: one TOML file per robot says which servo moves which joint, which way, from where.

    calibration = load("")                       # the shipped default
    calibration.to_step("lf_coxa", 0.1)
    calibration.to_radian("lf_coxa", 2113)

The file:

    version = 1
    robot = "my hexapod"

    [joint.lf_coxa]
    servo = 1          # id on the bus
    direction = 1      # or -1 where the servo counts against the joint
    zero_step = 2048   # what the servo reads at the neutral stance
"""

import math
import tomllib
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

from hexapod_driver.errors import CalibrationError
from hexapod_driver.feetech import MAX_ID, STEPS_PER_TURN
from tcbi_contract.names import JOINT_LIMIT, JOINTS

VERSION = 1
STEP_RAD = 2 * math.pi / STEPS_PER_TURN
_REACH = math.ceil(JOINT_LIMIT / STEP_RAD)  # steps from the neutral stance to the end of the joint range


@dataclass(frozen=True)
class JointCalibration:
    """One joint's servo: id, direction (1 or -1), reading at the neutral stance."""

    servo: int
    direction: int
    zero_step: int


@dataclass(frozen=True)
class Calibration:
    """All joints of one robot, in the contract's order."""

    robot: str
    joints: dict[str, JointCalibration]

    @property
    def servos(self) -> tuple[int, ...]:
        """Servo ids in the contract's joint order."""
        return tuple(joint.servo for joint in self.joints.values())

    def to_step(self, name: str, angle: float) -> int:
        """Servo step of a joint angle (rad), rounded to the nearest and kept inside one turn."""
        joint = self.joints[name]
        step = joint.zero_step + joint.direction * round(angle / STEP_RAD)
        return min(max(step, 0), STEPS_PER_TURN - 1)

    def to_radian(self, name: str, step: int) -> float:
        """Joint angle (rad) of a servo step."""
        joint = self.joints[name]
        return joint.direction * (step - joint.zero_step) * STEP_RAD


def load(path: str) -> Calibration:
    """Read a calibration file; the empty path is the shipped default.

    Raises:
      CalibrationError: the file cannot be read, or any of its faults, all at once.
    """
    source = Path(path) if path else Path(str(resources.files("hexapod_driver") / "calibration.toml"))
    try:
        content = tomllib.loads(source.read_text(encoding="utf-8"))
    except OSError as error:
        raise CalibrationError(
            f"calibration {source}: {error.strerror}; give the file with the parameter calibration, or leave it empty "
            "for the shipped default"
        ) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise CalibrationError(f"calibration {source}: not valid TOML: {error}") from error
    return parse(content, str(source))


def parse(content: dict, source: str) -> Calibration:
    """Check the content of a calibration file.

    Raises:
      CalibrationError: all its faults in one line.
    """
    faults = []
    if content.get("version") != VERSION:
        faults.append(f"version: got {content.get('version')!r}, allowed is {VERSION}")
    tables = content.get("joint", {})
    if not isinstance(tables, dict):
        tables = {}
    faults += [f"unknown joint {name!r}" for name in tables if name not in JOINTS]
    joints: dict[str, JointCalibration] = {}
    for name in JOINTS:
        if name not in tables:
            faults.append(f"joint {name} is missing")
            continue
        found = _joint_faults(name, tables[name])
        faults += found
        if not found:
            joints[name] = JointCalibration(**tables[name])
    faults += _shared_servos(joints)
    if faults:
        raise CalibrationError(f"calibration {source}: {'; '.join(faults)}")
    return Calibration(str(content.get("robot", "unnamed")), joints)


def _joint_faults(name: str, table: object) -> list[str]:
    allowed = {
        "servo": ("0 to 252", lambda v: 0 <= v <= MAX_ID),
        "direction": ("1 or -1", lambda v: v in (1, -1)),
        "zero_step": (f"{_REACH} to {STEPS_PER_TURN - 1 - _REACH}", lambda v: _REACH <= v < STEPS_PER_TURN - _REACH),
    }
    if not isinstance(table, dict):
        return [f"joint {name}: got {table!r}, allowed is a table with {', '.join(allowed)}"]
    faults = [f"joint {name}: unknown key {key!r}" for key in table if key not in allowed]
    for key, (text, holds) in allowed.items():
        value = table.get(key)
        if type(value) is not int or not holds(value):
            faults.append(f"joint {name}: {key}: got {value!r}, allowed is {text}")
    return faults


def _shared_servos(joints: dict[str, JointCalibration]) -> list[str]:
    users: dict[int, list[str]] = {}
    for name, joint in joints.items():
        users.setdefault(joint.servo, []).append(name)
    return [f"servo {servo} is given to {' and '.join(names)}" for servo, names in users.items() if len(names) > 1]
