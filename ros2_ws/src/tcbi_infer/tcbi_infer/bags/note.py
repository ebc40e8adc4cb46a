"""What the event's fixed fields cannot say of a rollout, as JSON in its `note`.

The rest of a scenario (duration, seed, initial posture, constants) and the rig travel in the BEGIN event's note, so
that they survive a conversion of the bag, a replay, and a cut. A note that is not such an object is plain text.
"""

import json
import math
from dataclasses import dataclass
from typing import Any

from tcbi_sim.measurement import Scenario

KEY = "tcbi"
VERSION = 1


@dataclass(frozen=True)
class Note:
    """A note taken apart; None and empty where it says nothing."""

    rig: str | None = None
    duration: float | None = None  # s
    initial_joint_position: tuple[float, ...] | None = None  # rad
    initial_joint_velocity: tuple[float, ...] | None = None  # rad/s
    initial_yaw: float = 0.0  # rad
    settle: float = 1.0  # s
    seed: int = 0
    constants: tuple[tuple[str, float], ...] = ()
    text: str = ""


def write_note(rig: str, scenario: Scenario, text: str = "") -> str:
    """The note of a BEGIN event."""
    content: dict[str, Any] = {
        KEY: VERSION,
        "rig": rig,
        "duration": scenario.duration,
        "seed": scenario.seed,
        "settle": scenario.settle,
        "initial_yaw": scenario.initial_yaw,
        "initial_joint_position": scenario.initial_joint_position,
        "initial_joint_velocity": scenario.initial_joint_velocity,
        "constants": [list(pair) for pair in scenario.constants],
        "text": text,
    }
    return json.dumps(content)


def read_note(note: str) -> Note:
    """A note of any origin; what does not parse is text."""
    try:
        content = json.loads(note) if note.lstrip().startswith("{") else None
    except ValueError:
        content = None
    if not isinstance(content, dict) or KEY not in content:
        return Note(text=note)
    try:
        return _from(content)
    except (TypeError, ValueError):
        return Note(text=note)


def _from(content: dict[str, Any]) -> Note:
    duration = content.get("duration")
    constants = content.get("constants") or []
    pairs = constants.items() if isinstance(constants, dict) else constants
    return Note(
        rig=str(content["rig"]) if content.get("rig") else None,
        duration=None if duration is None or not math.isfinite(duration) else float(duration),
        initial_joint_position=_numbers(content.get("initial_joint_position")),
        initial_joint_velocity=_numbers(content.get("initial_joint_velocity")),
        initial_yaw=float(content.get("initial_yaw", 0.0)),
        settle=float(content.get("settle", 1.0)),
        seed=int(content.get("seed", 0)),
        constants=tuple((str(name), float(value)) for name, value in pairs),
        text=str(content.get("text", "")),
    )


def _numbers(values: list[Any] | None) -> tuple[float, ...] | None:
    return None if values is None else tuple(float(x) for x in values)
