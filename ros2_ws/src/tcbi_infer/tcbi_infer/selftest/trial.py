"""One robot after another: recorded, diagnosed, and what was found set beside what was planted.

bench = Bench.of(model, motions, settings, candidates)
for result in trials(bench, robots, keep=Path("selftest.jsonl")):
    result["outcome"]
"""

import dataclasses
import hashlib
import json
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from tcbi_infer.compare.replicates import find_replicates
from tcbi_infer.diagnose.diagnosis import diagnose
from tcbi_infer.diagnose.evidence import CANNOT_TELL, EFFECT, NOTHING_MISSING, Diagnosis
from tcbi_infer.diagnose.motions import Motion
from tcbi_infer.diagnose.settings import Settings
from tcbi_infer.errors import InferError
from tcbi_infer.selftest.robot import Robot
from tcbi_sim.measurement import Measurement
from tcbi_sim.model import Model
from tcbi_sim.ray_workers import versions

RIGHT, UNSURE, WRONG, MISSED, FALSE_ALARM = "right", "unsure", "wrong", "missed", "false alarm"
Result = dict[str, Any]
Progress = Callable[[Robot, str, float], None]  # robot, stage, share done


@dataclasses.dataclass(frozen=True)
class Bench:
    """What every robot of a self-test is put through."""

    model: Model
    motions: tuple[Motion, ...]
    settings: Settings
    candidates: tuple[str, ...]

    @property
    def fingerprint(self) -> str:
        """Changes with anything that a result depends on besides the robot, the code and the user's own files too."""
        what = (versions(), self.model.version, self.model.effects, self.settings, self.candidates)
        digest = hashlib.sha256(repr(what).encode())
        digest.update(self.model.contents)
        for motion in self.motions:
            c = motion.commands
            digest.update(repr((motion.name, motion.policy_id, motion.scenario, c.ramp)).encode())
            digest.update(c.time.tobytes() + c.target.tobytes())
            digest.update(b"" if c.torque_on is None else c.torque_on.tobytes())
        return digest.hexdigest()[:16]


def motions_of(rollouts: Sequence[Measurement]) -> tuple[Motion, ...]:
    """The commands and circumstances of recorded rollouts, replicates once."""
    firsts = [rollouts[group.members[0]] for group in find_replicates(rollouts)]
    names = [f"{m.policy_id or 'motion'} {i}" for i, m in enumerate(firsts, 1)]
    return tuple(
        Motion(name, "as recorded", m.scenario, m.commands, policy_id=m.policy_id)
        for name, m in zip(names, firsts, strict=True)
    )


def trials(
    bench: Bench, robots: Sequence[Robot], keep: Path | None = None, progress: Progress | None = None
) -> Iterator[Result]:
    """The result of every robot, those kept from an earlier run first.

    Args:
      bench: what they are put through.
      robots: which.
      keep: file of results, one JSON object a line; what is there already is not run again.
      progress: called within each robot.

    Raises:
      InferError: the file cannot be read or written.
    """
    fingerprint = bench.fingerprint
    done = kept(keep, fingerprint) if keep else {}
    yield from (done[robot] for robot in robots if robot in done)
    for robot in robots:
        if robot in done:
            continue
        result = trial(bench, robot, progress)
        if keep:
            remember(keep, fingerprint, result)
        yield result


def trial(bench: Bench, robot: Robot, progress: Progress | None = None) -> Result:
    """Record a robot, diagnose it, and say what was found."""
    say = progress or (lambda robot, stage, share: None)
    began = time.process_time()
    say(robot, "recording", 0.0)
    rollouts = robot.record(bench.model, bench.motions)
    found = diagnose(
        bench.model,
        rollouts,
        uses=bench.candidates,
        settings=bench.settings,
        progress=lambda stage, share: say(robot, stage, 0.1 + 0.9 * share),
    )
    evidence = next((e for e in found.ranking if e.use == robot.use), None)
    named = next((e for e in found.ranking if e.use in found.uses[:1]), None)
    return {
        **dataclasses.asdict(robot),
        "effect": robot.effect,
        "planted": robot.planted(bench.model),
        "outcome": outcome(robot, found),
        "verdict": found.verdict,
        "uses": list(found.uses),
        "statement": found.statement,
        "error_before": found.errors["base"],
        "error_after": named.error_after if named and named.refined else found.errors["base"],
        "threshold": found.threshold,
        "statistic": evidence.statistic if evidence and math.isfinite(evidence.statistic) else None,
        "fitted": {p.name: [p.value, p.low90, p.high90] for p in evidence.parameters} if evidence else {},
        "detectable": {s.parameter: s.value for s in found.detectable if s.use == robot.use and s.parameter},
        "cpu_s": time.process_time() - began,
    }


def outcome(robot: Robot, found: Diagnosis) -> str:
    """In a word: right, unsure (names it among others), wrong (names another), missed, or false alarm.

    Of a robot with nothing planted it is no false alarm that the rollouts cannot tell, if no effect is named.
    """
    if not robot.use:
        silent = found.verdict == NOTHING_MISSING or (found.verdict == CANNOT_TELL and not found.uses)
        return RIGHT if silent else FALSE_ALARM
    if robot.use in found.uses:
        return RIGHT if found.verdict == EFFECT else UNSURE
    return WRONG if found.verdict in (EFFECT, CANNOT_TELL) and found.uses else MISSED


def kept(path: Path, fingerprint: str) -> dict[Robot, Result]:
    """Results of an earlier run with the same model, motions and settings; a line that was cut off does not count."""
    if not path.exists():
        return {}
    try:
        lines = path.read_text().splitlines()
    except (OSError, UnicodeDecodeError) as e:
        raise InferError(f"cannot read {path}: {e}; choose another file for --keep") from e
    found: dict[Robot, Result] = {}
    for number, line in enumerate(lines, 1):
        try:
            entry = json.loads(line)
            result: Mapping[str, Any] = entry["result"]
            robot = Robot(result["use"], result["strength"], result["seed"])
        except (ValueError, KeyError, TypeError) as e:
            if number == len(lines):
                continue
            raise InferError(
                f"{path}, line {number}, is no result of a self-test; choose another file for --keep"
            ) from e
        if entry["of"] == fingerprint:
            found[robot] = dict(result)
    return found


def remember(path: Path, fingerprint: str, result: Result) -> None:
    """Append a result as one line, in place of a line that was cut off."""
    line = json.dumps({"of": fingerprint, "result": result}) + "\n"
    try:
        with path.open("a+b") as file:
            file.seek(0)
            file.truncate(file.read().rfind(b"\n") + 1)
            file.write(line.encode())
    except OSError as e:
        raise InferError(f"cannot write {path}: {e.strerror}; free space, or choose another file for --keep") from e
