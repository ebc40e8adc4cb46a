"""What a diagnosis of the store advises to record next, and how to ask the graph's recorder for it."""

import csv
import io
import shlex
from collections.abc import Mapping
from typing import Any

from tcbi_infer.diagnose.evidence import NextMotion

TIMES = 2  # each motion is recorded: the robot must be seen to repeat itself
COMMAND = "./tcbi collect"


def motions(diagnosis: Mapping[str, Any]) -> list[NextMotion]:
    """The motions that a diagnosis, as JSON, names."""
    return [
        NextMotion(**{**m, "between": tuple(m["between"]), "table": tuple(map(tuple, m["table"]))})
        for m in diagnosis.get("next_motions", ())
        if m["nats"] is not None
    ]


def collection(motion: NextMotion) -> dict[str, Any]:
    """Options of a collection that does what the motion's command does.

    Args:
      motion: with a command.
    """
    said = shlex.split(motion.command.partition(COMMAND)[2].partition(";")[0])
    options = dict(zip(said[::2], said[1::2], strict=True))
    return {
        "task": options["--task"],
        "policy": options["--policy"],
        "number": 1,
        "times": TIMES,
        "seed": int(options["--seed"]),
        "duration_s": float(options["--duration"]),
        "slope_roll": float(options["--slope-roll"]),
        "slope_pitch": float(options["--slope-pitch"]),
    }


def as_csv(motion: NextMotion) -> bytes:
    """The commands of a motion for a rig that has no recorder here: time (s), then a target (rad or N m) a joint."""
    text = io.StringIO()
    rows = csv.writer(text)
    rows.writerow(["time_s", *(f"target_{j}" for j in range(len(motion.table[0]) - 1))])
    rows.writerows(motion.table)
    return text.getvalue().encode()
