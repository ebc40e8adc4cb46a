"""What a policy observes and commands: names, units and order, and how a policy is checked against them."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass

from tcbi_contract.names import CONTROL_RATE_HZ, JOINT_LIMIT, JOINTS
from tcbi_policy.entries import NAMES, POSITIVE, TEXT
from tcbi_policy.errors import PolicyMisfit

ATTITUDE_NAMES = ("roll", "pitch", "yaw_since_start")
REMEDY = "take one that was trained for this robot (./tcbi policy lists policies), or train one with ./tcbi train"
ENTRIES = {"observation": NAMES, "action": NAMES, "limit": POSITIVE, "rate_hz": POSITIVE, "unit": TEXT}  # in a card


@dataclass(frozen=True)
class Layout:
    """Names and units of the observation and the action, in order, at one control rate."""

    observation: tuple[str, ...]
    action: tuple[str, ...]
    limit: float  # rad, either side of zero, of every action
    rate_hz: float
    unit: str = "rad"  # of every entry of both

    def to_json(self) -> dict:
        """The layout as the card writes it."""
        return asdict(self)

    @staticmethod
    def from_json(data: dict) -> "Layout":
        """The layout that a card holds, whose entries are of the kinds in ENTRIES."""
        known = {key: data[key] for key in ("limit", "rate_hz", "unit")}
        return Layout(tuple(data["observation"]), tuple(data["action"]), **known)


def robot_layout(
    joints: Sequence[str] = JOINTS, limit: float = JOINT_LIMIT, rate_hz: float = CONTROL_RATE_HZ
) -> Layout:
    """What a robot with these joints offers: all joint angles and the attitude in, all joint targets out."""
    return Layout((*joints, *ATTITUDE_NAMES), tuple(joints), float(limit), float(rate_hz))


HEXAPOD = robot_layout()


def check_fit(policy: str, layout: Layout, robot: Layout, remedy: str = REMEDY) -> None:
    """Refuse a policy whose layout is not the robot's; the line ends with what to do instead.

    Raises:
      PolicyMisfit: everything that differs, by name.
    """
    faults = [*_compare("observation", layout.observation, robot.observation),
              *_compare("action", layout.action, robot.action)]  # fmt: skip
    if layout.unit != robot.unit:
        faults.append(f"unit is {layout.unit}, the robot's is {robot.unit}")
    if layout.limit > robot.limit + 1e-9:
        faults.append(f"joint range is +-{layout.limit:.4f} rad, the robot's is +-{robot.limit:.4f} rad")
    if abs(layout.rate_hz - robot.rate_hz) > 1e-9:
        faults.append(f"control rate is {layout.rate_hz:g} Hz, the robot's is {robot.rate_hz:g} Hz")
    if faults:
        raise PolicyMisfit(f"policy {policy} does not fit this robot: {'; '.join(faults)}; {remedy}")


def _compare(what: str, mine: tuple[str, ...], robots: tuple[str, ...]) -> list[str]:
    faults = []
    missing = [name for name in mine if name not in robots]
    extra = [name for name in robots if name not in mine]
    if missing:
        faults.append(f"{what} needs {', '.join(missing)}, which the robot lacks")
    if extra:
        faults.append(f"{what} lacks {', '.join(extra)}, which the robot has")
    if not faults and mine != robots:
        k = next(i for i, (a, b) in enumerate(zip(mine, robots, strict=True)) if a != b)
        faults.append(f"{what} order differs from entry {k} on: {mine[k]} where the robot has {robots[k]}")
    return faults
