"""Robots with something hidden in them: is it found, is nothing found where nothing is, and how sure may one be?

./tcbi python bench/hidden.py --quick                                     # one robot of each kind
./tcbi python bench/hidden.py --plan quick --seeds 200:205                # five of each, as the quick demo diagnoses
./tcbi python bench/hidden.py --plan full --hidden none --seeds 300:320 --keep none.jsonl

Each robot is an emulated one (its own physics; docs/emulated_robot.md), recorded and diagnosed as the demo of the
same name does, only in process and faster than real time. `--keep FILE` holds one JSON line for each robot; what is
there already is not run again, so a stopped run goes on.
"""

import argparse
import dataclasses
import json
import multiprocessing
import resource
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from tcbi_bringup.demo.plan import FULL, QUICK, Plan, slope_of
from tcbi_bringup.emulated_robot.as_measurement import measure
from tcbi_bringup.emulated_robot.hidden_effects import EFFECTS, NONE, STRENGTHS
from tcbi_bringup.emulated_robot.rollout import EmulatedRobot
from tcbi_infer.collection import Request, scenario_of
from tcbi_infer.compare.comparison import compare
from tcbi_infer.diagnose.adopt import adopt
from tcbi_infer.diagnose.diagnosis import diagnose
from tcbi_infer.diagnose.evidence import CANNOT_TELL, EFFECT, NOTHING_MISSING
from tcbi_policy.gaits import Gait
from tcbi_sim.measurement import Measurement
from tcbi_sim.model import base_model

PLANS = {"quick": QUICK, "full": FULL}
BASE = ("friction", "mass", "gain")
SIZES = {  # the library's parameter that says the same as the truth's
    "coulomb_friction": ("torque", "sliding_torque_n_m"),
    "viscous_damping": ("damping", "damping_n_m_s_per_rad"),
    "command_latency": ("delay", "latency_s"),
    "backlash": ("gap", "gap_rad"),
    "weak_leg": ("scale", "remaining_torque_share"),
    "payload": ("mass", "mass_kg"),
}
Result = dict[str, Any]


def recorded(robot: EmulatedRobot, gaits: tuple[str, ...], plan: Plan, seed: int) -> list[Measurement]:
    """The plan's motions, each twice, on the same slopes as in the demo."""
    rollouts = []
    for i, gait in enumerate(gaits):
        roll, pitch = slope_of(i)
        request = Request("balance", 1, seed + i, slope_roll=(roll,), slope_pitch=(pitch,), duration_s=plan.motion_s)
        for trial in (0, 1):
            rollout = measure(robot, scenario_of(request, 0), Gait(gait), trial=2 * (seed + i) + trial)
            rollouts.append(dataclasses.replace(rollout, rollout_id=f"{gait}-{trial}"))
    return rollouts


def judged(job: tuple[str, str, str, int]) -> Result:
    """Record a robot, diagnose it, add what is found, and judge the new version on motions that no fit has seen."""
    plan_name, hidden, strength, seed = job
    plan = PLANS[plan_name]
    robot = EmulatedRobot(seed, hidden, strength)
    truth = robot.specimen.truth()
    seen = recorded(robot, plan.motions, plan, 0)
    unseen = recorded(robot, plan.unseen, plan, 100)
    model = base_model("hexapod")
    began, cpu = time.perf_counter(), time.process_time()
    found = diagnose(model, seen, uses=plan.effects, settings=plan.settings)
    spent = {"wall_s": time.perf_counter() - began, "cpu_s": time.process_time() - cpu}
    use = found.uses[0] if found.verdict == EFFECT else ""
    added = adopt(model, use, found.to_json())
    floor = compare(model, seen, particles=0).floor
    errors = [compare(m, unseen, particles=0, floor=floor).error_over_floor for m in (model, added)]
    return {
        "plan": plan_name,
        "hidden": hidden,
        "strength": strength,
        "seed": seed,
        "verdict": found.verdict,
        "uses": list(found.uses),
        "first": found.ranking[0].use if found.ranking else "",
        "statistic": found.ranking[0].statistic if found.ranking else None,
        "threshold": found.threshold,
        "errors": errors,
        "truth": truth,
        "base": [dataclasses.asdict(p) for p in found.base.parameters],
        "ranking": [
            {"use": e.use, "statistic": e.statistic, "accepted": e.accepted, "reason": e.reason,
             "error_after": e.error_after, "parameters": [dataclasses.asdict(p) for p in e.parameters]}
            for e in found.ranking if e.refined
        ],
        "statement": found.statement,
        "peak_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        **spent,
    }  # fmt: skip


def outcome(result: Result) -> str:
    """In a word: right, unsure (names the truth among others), wrong, missed, or false alarm."""
    hidden, verdict, uses = result["hidden"], result["verdict"], result["uses"]
    leg = result["truth"]["effect"].get("leg")
    right = f"{hidden}:{leg}" if leg else hidden
    if hidden == NONE:
        return "right" if verdict == NOTHING_MISSING else "false alarm"
    if verdict == EFFECT:
        return "right" if right in uses else "wrong"
    if verdict == CANNOT_TELL:
        return "unsure" if right in uses else "wrong"
    return "missed"


def results(jobs: list[tuple[str, str, str, int]], keep: Path | None, workers: int) -> Iterator[Result]:
    """Of all jobs, those kept from an earlier run first."""
    done = {}
    if keep and keep.exists():
        for line in keep.read_text().splitlines():
            old = json.loads(line)
            done[old["plan"], old["hidden"], old["strength"], old["seed"]] = old
    yield from (done[job] for job in jobs if job in done)
    left = [job for job in jobs if job not in done]
    began = time.monotonic()
    with multiprocessing.get_context("spawn").Pool(workers, maxtasksperchild=1) as pool:
        for i, result in enumerate(pool.imap_unordered(judged, left), 1):
            if keep:
                with keep.open("a") as file:
                    file.write(json.dumps(result, default=str) + "\n")
            rest = (time.monotonic() - began) / i * (len(left) - i)
            line = f"{result['hidden']} ({result['strength']}) seed {result['seed']}: {outcome(result)}; "
            print(f"{i}/{len(left)}, {rest:.0f} s left; {line}{result['statement']}", file=sys.stderr, flush=True)
            yield result


def figures(found: list[Result]) -> list[dict[str, Any]]:
    """Shares of each outcome, coverage of intervals, errors and cost."""
    rows = []
    for hidden in dict.fromkeys(r["hidden"] for r in found):
        for strength in dict.fromkeys(r["strength"] for r in found if r["hidden"] == hidden):
            mine = [outcome(r) for r in found if (r["hidden"], r["strength"]) == (hidden, strength)]
            named = f"{hidden} ({strength})" if hidden != NONE else "nothing hidden"
            rows += [figure(f"{named}: {word}", mine.count(word), f"of {len(mine)}") for word in dict.fromkeys(mine)]
    inside = [p for r in found if r["hidden"] == NONE for p in contains(r["base"], plain_truth(r))]
    rows.append(figure("90 % intervals of base parameters that hold the truth, nothing hidden", share(inside), "1"))
    sizes = [s for r in found if outcome(r) == "right" and r["hidden"] in SIZES for s in size_inside(r)]
    rows.append(figure("90 % intervals of the effect's size that hold the truth", share(sizes), "1"))
    right = [r for r in found if outcome(r) == "right"]
    for i, name in enumerate(("before", "after")):
        values = [r["errors"][i] for r in right]
        rows.append(figure(f"median error over the floor on unseen motions, {name}", median(values), "1"))
    rows.append(figure("median processor time of a diagnosis", median([r["cpu_s"] for r in found]), "s"))
    rows.append(figure("median memory", median([r["peak_mib"] for r in found]), "MiB", 2048.0))
    return rows


def plain_truth(result: Result) -> dict[str, float]:
    """The base parameters' true values."""
    return {name: float(result["truth"][name]) for name in BASE}


def contains(parameters: list[dict[str, Any]], truth: dict[str, float]) -> list[bool]:
    """Whether each interval holds its true value."""
    return [p["low90"] <= truth[p["name"]] <= p["high90"] for p in parameters if p["name"] in truth]


def size_inside(result: Result) -> list[bool]:
    """Whether the interval of the effect's size holds the truth; empty where the truth has no such number."""
    name, key = SIZES[result["hidden"]]
    true = result["truth"]["effect"].get(key)
    best = result["ranking"][0]
    return [
        p["low90"] <= true <= p["high90"] for p in best["parameters"] if true is not None and p["name"].endswith(name)
    ]


def share(hits: list[bool]) -> float:
    """Of true ones; NaN of none."""
    return float(np.mean(hits)) if hits else float("nan")


def median(values: list[float]) -> float:
    """NaN of none."""
    return float(np.median(values)) if values else float("nan")


def figure(name: str, value: float, unit: str, target: float | None = None) -> dict[str, Any]:
    """One measured figure beside its target, if it has one."""
    met = None if target is None else value <= target
    return {
        "name": name,
        "value": None if np.isnan(value) else round(value, 3),
        "unit": unit,
        "target": target,
        "met": met,
    }


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="one robot of each kind, quick diagnosis")
    parser.add_argument("--plan", choices=PLANS, default="quick", help="which demo's recording and diagnosis")
    parser.add_argument("--hidden", default=",".join((NONE, *EFFECTS)), help="effects and none, with commas")
    parser.add_argument("--strength", default="strong", help="strong, weak or both with a comma")
    parser.add_argument("--seeds", default="200:203", help="first:end of the robots' numbers")
    parser.add_argument("--keep", type=Path, help="file of results, one JSON object a line")
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    first, end = (int(n) for n in options.seeds.split(":"))
    seeds = range(first, first + 1 if options.quick else end)
    jobs = [
        (options.plan, hidden, strength, seed)
        for seed in seeds
        for hidden in options.hidden.split(",")
        for strength in (options.strength.split(",") if hidden != NONE else STRENGTHS[:1])
    ]
    found = list(results(jobs, options.keep, options.workers))
    print(json.dumps({"name": "hidden", "figures": figures(found)}, indent=2))
    return 0


if __name__ == "__main__":
    sys.exit(main())
