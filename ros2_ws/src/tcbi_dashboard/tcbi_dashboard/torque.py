"""Whether the robot's servos have torque, as its diagnostics say, and what leads on from there in the page's words."""

from collections.abc import Mapping
from dataclasses import dataclass

from tcbi_contract.safety import Mode

STOP, RELEASE, RESET = "EMERGENCY STOP", "Release the stop", "Reset the robot"  # the page's buttons
OLD_S = 3.0  # diagnostics come once a second
KEYS = ("mode", "torque")  # in which the driver and the simulation tell it
MODES = {mode.value: mode for mode in Mode}
NO_LEAVE = "This page may stop the robot, but not move it: start ./tcbi dashboard with --allow-motion for that."
WORDS = (  # what nodes tell a programmer, and the same for whoever has the page before them
    ("call emergency_stop/release, then reset_episode to arm", f'press "{RELEASE}", then "{RESET}" on the Live view'),
    ("call emergency_stop/release, then reset_episode", f'press "{RELEASE}", then "{RESET}" on the Live view'),
    ("call emergency_stop/release first", f'press "{RELEASE}" on the Live view first'),
    ("call reset_episode to arm the robot again", f'press "{RESET}" on the Live view'),
    ("call reset_episode to arm", f'press "{RESET}" on the Live view'),
    ("call reset_episode", f'press "{RESET}" on the Live view'),
    ("until reset_episode", "until it is reset"),
    ("reset_episode failed: reset: ", "the robot could not be reset: "),
    ("policy/load failed: ", ""),
    ("start the graph (./tcbi up), or let --robot start one", "start the graph with ./tcbi up"),
)


@dataclass(frozen=True)
class Torque:
    """What the robot says of itself.

    Attributes:
      needs_reset: it takes no commands until it is reset.
      reason: why the torque is off.
      confirmed: nothing says that servos were told to have no torque, but do not confirm it.
    """

    mode: Mode
    needs_reset: bool = False
    reason: str = ""
    confirmed: bool = True

    @staticmethod
    def of(values: Mapping[str, str], sentence: str) -> "Torque | None":
        """Of one status of the diagnostics: its values and its sentence; None where it tells nothing of the torque."""
        mode = next((MODES[values[key]] for key in KEYS if values.get(key) in MODES), None)
        if mode is None:
            return None
        reason = sentence.partition(f"{Mode.LIMP.value}: ")[2].partition(";")[0]
        return Torque(mode, values.get("needs_reset") == "true", reason, "torque_unconfirmed" not in values)


STOPPED = Torque(Mode.STOPPED, needs_reset=True)
RELEASED = Torque(Mode.LIMP, needs_reset=True, reason="emergency stop released")
STANDING = Torque(Mode.ACTIVE)


@dataclass(frozen=True)
class Shown:
    """What the page says of it, and the buttons that lead on."""

    head: str
    then: str = ""
    stopped: bool = False
    release: bool = False
    reset: bool = False
    old: bool = False


def shown(torque: Torque | None, age_s: float, motion: bool) -> Shown:
    """The state as it was heard `age_s` ago; `motion` says whether this page may move the robot."""
    if torque is None:
        return Shown("No robot has said whether its torque is on.", old=True)
    old = age_s > OLD_S
    since = f" (not heard for {ago(age_s)})" if old else ""
    if torque.mode is Mode.ACTIVE:
        return Shown(f"Torque is on{since}", old=old)
    off = "torque is off" if torque.confirmed else "torque off is not confirmed, cut the power to be sure"
    if torque.mode is Mode.STOPPED:
        then = f'Next: "{RELEASE}". Nothing moves then; the torque comes back with "{RESET}" or with a recording.'
        return Shown(f"STOPPED: {off}{since}", then if motion else NO_LEAVE, True, motion, old=old)
    head = f"T{off[1:]}{f': {torque.reason}' if torque.reason else ''}{since}"
    if not torque.needs_reset:
        return Shown(head, "" if old else "It comes back with the next command.", old=old)
    then = f'Next: "{RESET}": it takes its starting posture. A recording does the same first.'
    return Shown(head, then if motion else NO_LEAVE, reset=motion, old=old)


def ago(seconds: float) -> str:
    """A span of time in words."""
    for size, unit in ((3600, "h"), (60, "min")):
        if seconds >= 2 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{seconds:.0f} s"


def in_page_words(text: str) -> str:
    """What a node says, with the page's buttons for the names of services."""
    for told, said in WORDS:
        text = text.replace(told, said)
    return text
