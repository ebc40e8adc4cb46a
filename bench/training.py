"""How fast the preset `fast` learns from scratch, over several seeds.

./tcbi python bench/training.py --keep balance.jsonl                       # balance, seeds 0 to 4
./tcbi python bench/training.py --quick                                    # one seed, a third of the steps
./tcbi python bench/training.py --task forward --seeds 0:3 --keep forward.jsonl
./tcbi python bench/training.py --keep docs/learning_curve_balance.jsonl --figure docs/images/learning_curve_balance.svg

Draws are from the prior of the hexapod as it is built in. `--keep FILE` holds one JSON line for each seed; what is
there already of the same configuration and the same code is not run again, so a stopped run goes on. `--figure` draws
the curves.
"""

import argparse
import dataclasses
import hashlib
import json
import re
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import stdtrit

from tcbi_bringup.commands.bench import figure
from tcbi_infer.report.plots import BLUE, GREY, STYLE, WIDE
from tcbi_policy.configuration import TrainingConfig, preset
from tcbi_policy.runs import LOADED
from tcbi_policy.training import Training
from tcbi_sim.model import base_model

BUDGET_S = 90.0  # of processor time, within which the tilt is to be halved
ENOUGH = 0.8  # share of the seeds that must do it
Result = dict[str, Any]
MEASURES = {  # of an evaluation, by task: key, label, factor
    "balance": ("final_inclination_deg", "final inclination / degrees", 1.0),
    "forward": ("distance_m", "distance in 30 s, mean / m", 1.0),
}


def configured(task: str, seed: int, steps: int) -> TrainingConfig:
    """The preset with a seed, on one thread; `steps` 0 for the preset's."""
    config = preset("fast", task)
    return dataclasses.replace(config, seed=seed, threads=1, steps=steps or config.steps)


def facts(config: TrainingConfig) -> Result:
    """By which a kept result is known to be of this configuration, this code and these libraries."""
    digest = hashlib.sha256(json.dumps(dataclasses.asdict(config), sort_keys=True).encode()).hexdigest()[:12]
    return {"task": config.task, "seed": config.seed, "steps": config.steps, "configuration": digest, "on": LOADED}


def trained(config: TrainingConfig) -> Result:
    """One training from scratch, and its evaluations in scenarios that it does not see."""
    with tempfile.TemporaryDirectory() as folder:
        training = Training(Path(folder), config, base_model("hexapod"))
        training.run()
    return facts(config) | {"curve": training.state.curve}


def results(task: str, seeds: range, steps: int, keep: Path | None) -> list[Result]:
    """Of all seeds, in their order; those kept from an earlier run of the same configuration are not run again."""
    kept = [json.loads(line) for line in keep.read_text().splitlines()] if keep and keep.exists() else []
    found = []
    for seed in seeds:
        config = configured(task, seed, steps)
        mine = facts(config)
        result = next((r for r in kept if {key: r.get(key) for key in mine} == mine), None)
        if result is None:
            result = trained(config)
            print(f"seed {seed}: {result['curve'][-1]}", file=sys.stderr, flush=True)
            if keep:
                with keep.open("a") as file:
                    file.write(json.dumps(result) + "\n")
        found.append(result)
    return found


def figures(found: list[Result]) -> list[dict[str, Any]]:
    """Time to half the tilt, how many seeds made it, and where the curves end."""
    task = found[0]["task"]
    key, label, factor = MEASURES[task]
    ends = np.array([r["curve"][-1][key] * factor for r in found])
    rows = [
        figure(f"{label}, untrained", float(np.mean([r["curve"][0][key] for r in found])), "1"),
        figure(f"{label}, at the end, mean over {len(found)} seeds", float(ends.mean()), "1"),
        figure("half of the 95 % interval of that mean", half_width(ends), "1"),
        figure("processor time of a training, median", float(np.median([r["curve"][-1]["cpu_s"] for r in found])), "s"),
    ]
    if task == "balance":
        times = [time_to_half(r["curve"], key) for r in found]
        share = float(np.mean([t <= BUDGET_S for t in times]))
        rows.insert(0, figure("processor time to half the tilt, median", float(np.median(times)), "s", most=BUDGET_S))
        rows.insert(0, figure(f"share of seeds that halve the tilt in {BUDGET_S:.0f} s", share, "1", least=ENOUGH))
    return rows


def time_to_half(curve: list[dict[str, float]], key: str) -> float:
    """Processor seconds until an evaluation shows half the first one's value; infinite if none does."""
    return next((p["cpu_s"] for p in curve if p[key] <= curve[0][key] / 2), float("inf"))


def half_width(values: np.ndarray, axis: int = 0) -> Any:
    """Half of Student's 95 % interval of a mean over seeds."""
    n = values.shape[axis]
    return float("nan") if n < 2 else stdtrit(n - 1, 0.975) * values.std(axis=axis, ddof=1) / np.sqrt(n)


def draw(found: list[Result], path: Path) -> None:
    """The seeds' curves over processor time, their mean, and its 95 % interval."""
    import matplotlib
    from matplotlib.figure import Figure

    key, label, factor = MEASURES[found[0]["task"]]
    with matplotlib.rc_context(STYLE | {"text.color": "black", "axes.labelcolor": "black", "svg.hashsalt": "tcbi"}):
        canvas = Figure(figsize=(WIDE, 3.0), layout="constrained")
        axes = canvas.add_subplot()
        for r in found:
            axes.plot([p["cpu_s"] for p in r["curve"]], [factor * p[key] for p in r["curve"]], color=GREY, lw=0.7)
        count = min(len(r["curve"]) for r in found)
        time = np.mean([[p["cpu_s"] for p in r["curve"][:count]] for r in found], axis=0)
        values = np.array([[factor * p[key] for p in r["curve"][:count]] for r in found])
        mean, half = values.mean(axis=0), half_width(values)
        axes.fill_between(
            time, mean - half, mean + half, color=BLUE, alpha=0.2, lw=0, label="95 % interval of the mean"
        )
        axes.plot(time, mean, "o-", color=BLUE, ms=3, label=f"mean of {len(found)} seeds")
        axes.set_xlabel("processor time / s")
        axes.set_ylabel(label)
        axes.set_ylim(bottom=0)
        axes.legend()
        canvas.savefig(path, metadata={"Date": None})


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="one seed, a third of the steps")
    parser.add_argument("--task", choices=MEASURES, default="balance")
    parser.add_argument("--seeds", default="0:5", help="first:end")
    parser.add_argument("--keep", type=Path, help="file of results, one JSON object a line")
    parser.add_argument("--figure", type=Path, help="SVG to draw")
    options = parser.parse_args()
    asked = re.fullmatch(r"(\d+):(\d+)", options.seeds)
    if asked is None or int(asked[2]) <= int(asked[1]):
        raise SystemExit(f"--seeds {options.seeds}: allowed is FIRST:END, such as 0:5")
    first, end = int(asked[1]), int(asked[2])
    steps = preset("fast", options.task).steps // 3 if options.quick else 0
    found = results(options.task, range(first, first + 1 if options.quick else end), steps, options.keep)
    if options.figure:
        draw(found, options.figure)
    print(json.dumps({"name": "training", "figures": figures(found)}, indent=2))
    return 0


if __name__ == "__main__":
    sys.exit(main())
