"""One robot of the benchmark: recorded, diagnosed until nothing more is found, judged on motions that no fit saw."""

import dataclasses
import json
import multiprocessing
import resource
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from tcbi_bringup.demo.plan import FULL, QUICK, Plan, Recording, recordings, slope_of
from tcbi_bringup.emulated_robot.as_measurement import measure
from tcbi_bringup.emulated_robot.hidden_names import parts
from tcbi_bringup.emulated_robot.rollout import EmulatedRobot
from tcbi_bringup.errors import BringupError
from tcbi_infer.collection import Request, scenario_of
from tcbi_infer.compare.comparison import compare
from tcbi_infer.diagnose.adopt import adopt
from tcbi_infer.diagnose.evidence import Diagnosis
from tcbi_infer.diagnose.rounds import MOST, rounds
from tcbi_policy.gaits import Gait
from tcbi_sim.measurement import Measurement
from tcbi_sim.model import Model, base_model

# 90 s of motion as a user would record it, against the whole library
BENCH = dataclasses.replace(
    FULL,
    motions=("steps", "sinus", "tripod", "squat", "steps:1", "twist", "dither", "sinus:1", "chirp"),
    repeated=9,
    motion_s=5.0,
    effects=(),
)
FORMAT = 2  # of kept results; 1 had no base model fitted for comparison
PLANS = {"quick": QUICK, "full": FULL, "bench": BENCH, "weighed": QUICK}  # the last with the mass that scales show
Job = tuple[str, str, str, int]  # plan, hidden, strength, seed
Result = dict[str, Any]


def recorded(robot: EmulatedRobot, wanted: list[Recording], duration: float, seed: int) -> list[Measurement]:
    """Motions of some duration in s, on the same slopes as in the demo."""
    rollouts = []
    for i, gait, trial in wanted:
        roll, pitch = slope_of(i)
        request = Request("balance", 1, seed + i, slope_roll=(roll,), slope_pitch=(pitch,), duration_s=duration)
        rollout = measure(robot, scenario_of(request, 0), Gait(gait), trial=2 * (seed + i) + trial)
        rollouts.append(dataclasses.replace(rollout, rollout_id=f"{gait}-{trial}"))
    return rollouts


def judged(job: Job) -> Result:
    """Record a robot, diagnose it, add what is found, and judge the new version on motions that no fit has seen.

    A robot with several effects is diagnosed again with what was found in the model, until no effect is found. `errors`
    are over the noise floor: of the model that was diagnosed, of the same with its parameters fitted, and of the new
    version; `errors_own_floor` over that of the unseen motions alone, of which feet may slip more than in the others.
    """
    plan_name, hidden, strength, seed = job
    plan = PLANS[plan_name]
    robot = EmulatedRobot(seed, hidden, strength)
    seen = recorded(robot, recordings(plan.motions, plan.repeated), plan.motion_s, 0)
    unseen = recorded(robot, recordings(plan.unseen, len(plan.unseen)), plan.motion_s, 100)
    model = base_model("hexapod")
    if plan_name == "weighed":
        model = model.with_fixed({"mass": on_scales(robot)})
    began, cpu = time.perf_counter(), time.process_time()
    found, uses, added = _diagnosed(model, seen, plan, MOST if len(parts(hidden)) > 1 else 1)
    spent = {"wall_s": time.perf_counter() - began, "cpu_s": time.process_time() - cpu}
    floors = [compare(model, rollouts, particles=0).floor for rollouts in (seen, unseen)]
    versions = {"unfitted": model, "fitted": adopt(model, "", found[0].to_json()), "added": added}
    errors, own = (
        {name: compare(m, unseen, particles=0, floor=f).error_over_floor for name, m in versions.items()}
        for f in floors
    )
    return {
        "format": FORMAT,
        **dict(zip(("plan", "hidden", "strength", "seed"), job, strict=True)),
        **_told(found[0]),
        "found": uses,
        "rounds": [_told(d) for d in found[1:]],
        "errors": errors,
        "errors_own_floor": own,
        "truth": robot.specimen.truth(),
        "peak_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        **spent,
    }


def on_scales(robot: EmulatedRobot) -> float:
    """What the robot weighs in kg, with anything that it may carry."""
    truth = robot.specimen.truth()
    return float(truth["mass"] + truth["effect"].get("mass_kg", 0.0))


def _diagnosed(
    model: Model, seen: list[Measurement], plan: Plan, most: int
) -> tuple[list[Diagnosis], list[str], Model]:
    """Diagnoses, each of the version that the one before made, what was added, the last version (fitted at least)."""
    found = list(rounds(model, seen, most=most, uses=plan.effects or None, anyway=True, settings=plan.settings))
    last = found[-1]
    added = last.added or adopt(last.model, "", last.diagnosis.to_json())
    return [r.diagnosis for r in found], [r.use for r in found if r.use], added


def _told(found: Diagnosis) -> Result:
    """What one diagnosis says, as plain values."""
    return {
        "verdict": found.verdict,
        "uses": list(found.uses),
        "first": found.ranking[0].use if found.ranking else "",
        "statistic": found.ranking[0].statistic if found.ranking else None,
        "threshold": found.threshold,
        "base": [dataclasses.asdict(p) for p in found.base.parameters],
        "ranking": [
            {"use": e.use, "statistic": e.statistic, "accepted": e.accepted, "reason": e.reason,
             "error_after": e.error_after, "confused_with": list(e.confused_with),
             "parameters": [dataclasses.asdict(p) for p in e.parameters]}
            for e in found.ranking if e.parameters
        ],
        "statement": found.statement,
        "misfit": None if found.misfit is None else dataclasses.asdict(found.misfit),
    }  # fmt: skip


def results(
    jobs: list[Job], keep: Path | None, workers: int, progress: Callable[[int, int, float, Result], None]
) -> Iterator[Result]:
    """Of all jobs, those kept from an earlier run first.

    Args:
      jobs: which robots.
      keep: file of one JSON line for each robot; new ones are added to it.
      workers: processes.
      progress: called with how many of how many are done, the seconds left, and the newest result.

    Raises:
      BringupError: `keep` holds something else, or results of an older format.
    """
    done = _kept(keep) if keep and keep.exists() else {}
    yield from (done[job] for job in jobs if job in done)
    left = [job for job in jobs if job not in done]
    began = time.monotonic()
    with multiprocessing.get_context("spawn").Pool(workers, maxtasksperchild=1) as pool:
        for i, result in enumerate(pool.imap_unordered(judged, left), 1):
            result["at_once"] = workers
            if keep:
                with keep.open("a") as file:
                    file.write(json.dumps(result, default=str) + "\n")
            progress(i, len(left), (time.monotonic() - began) / i * (len(left) - i), result)
            yield result


def _kept(keep: Path) -> dict[Job, Result]:
    done: dict[Job, Result] = {}
    for number, line in enumerate(keep.read_text().splitlines(), 1):
        try:
            old = json.loads(line)
            seen = old.get("format", 1)
            done[old["plan"], old["hidden"], old["strength"], old["seed"]] = old
        except (ValueError, KeyError, AttributeError) as e:
            raise BringupError(f"{keep}, line {number}: no result of this benchmark; remove the line") from e
        if seen != FORMAT:
            raise BringupError(
                f"{keep}, line {number}: a result of format {seen}, allowed is {FORMAT}; its figures mean something "
                "else, so give --keep another file"
            )
    return done
