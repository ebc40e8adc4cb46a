"""The drawing that robot and model are both built from: dimensions, masses and the servo's data sheet.

Only the file of numbers is shared. It is found without importing the package that it lies in, so that nothing of the
model's code takes part in the emulated robot.
"""

import importlib.util
import tomllib
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from tcbi_bringup.emulated_robot.errors import EmulatedRobotError

LINKS = ("coxa", "femur", "tibia")
PACKAGE, FILE = "tcbi_sim", Path("rigs") / "hexapod.toml"


@dataclass(frozen=True)
class Hip:
    """Where a coxa axis crosses the trunk's mid plane (m) and where the leg points at zero (rad from +x)."""

    position: tuple[float, float, float]
    direction: float


@dataclass(frozen=True)
class Drawing:
    """The dimensions in m, kg, rad, N m, s."""

    trunk_size: tuple[float, float, float]
    trunk_mass: float
    imu_position: tuple[float, float, float]
    hips: dict[str, Hip]
    coxa_length: float
    femur_length: float
    tibia_length: float
    femur_elevation: float
    tibia_tilt: float
    coxa_mass: float
    femur_mass: float
    tibia_mass: float
    link_radius: float
    foot_radius: float
    joint_range: float
    torque_limit: float
    damping: float
    armature: float
    speed_limit: float
    foot_threshold: float

    @property
    def mass(self) -> float:
        """Sum of the drawn parts, kg."""
        return self.trunk_mass + len(self.hips) * (self.coxa_mass + self.femur_mass + self.tibia_mass)


def find() -> Path:
    """The file of dimensions.

    Raises:
      EmulatedRobotError: the package that carries it is not installed.
    """
    spec = importlib.util.find_spec(PACKAGE)
    for folder in (spec.submodule_search_locations or []) if spec else []:
        if (Path(folder) / FILE).is_file():
            return Path(folder) / FILE
    raise EmulatedRobotError(
        f"the robot's drawing {FILE} of package {PACKAGE} was not found; build the workspace again"
    )


@cache
def load() -> Drawing:
    """Read the drawing.

    Raises:
      EmulatedRobotError: the file is missing or lacks a number.
    """
    path = find()
    with path.open("rb") as file:
        table = tomllib.load(file)
    try:
        return _read(table)
    except (KeyError, TypeError) as error:
        raise EmulatedRobotError(f"the robot's drawing {path} lacks or misnames {error}; restore the file") from error


def _read(t: dict[str, Any]) -> Drawing:
    leg, servo = t["leg"], t["servo"]
    return Drawing(
        trunk_size=tuple(t["trunk"]["size"]),
        trunk_mass=t["trunk"]["mass"],
        imu_position=tuple(t["trunk"]["imu_position"]),
        hips={name: Hip(tuple(hip["position"]), hip["direction"]) for name, hip in t["hips"].items()},
        **{f"{link}_length": leg[f"{link}_length"] for link in LINKS},
        **{f"{link}_mass": leg[f"{link}_mass"] for link in LINKS},
        **{name: leg[name] for name in ("femur_elevation", "tibia_tilt", "link_radius", "foot_radius")},
        **{name: servo[name] for name in ("torque_limit", "damping", "armature", "speed_limit")},
        joint_range=t["joint"]["range"],
        foot_threshold=t["foot_switch"]["threshold"],
    )
