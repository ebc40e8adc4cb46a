"""One finding of a look at a machine or a robot, as `./tcbi doctor` shows it."""

from dataclasses import dataclass

OK, WARNING, FAULT = "ok", "warning", "fault"


@dataclass(frozen=True)
class Check:
    """What was looked at, how it stands (OK, WARNING or FAULT), what was found, what to do if it is not well."""

    name: str
    status: str
    found: str
    remedy: str = ""
