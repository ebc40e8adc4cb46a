"""From what was found to the paper's Tables 3 to 6, as plain data.

Every row says on how many robots and rollouts it stands. Intervals are 95 %, from resampling robots (where there are
three or more) and the rollouts within them; with fewer robots they speak of these robots alone, and the tables say so.
What an inference gives is one number for each robot: its interval comes from resampling robots, and with fewer than
three there is none (NaN).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import ttest_ind

from tcbi_bringup.study.notebook import Notebook, Result
from tcbi_bringup.study.plan import EFFECT, FIRST, LABELS, WINNER, Plan

RESAMPLES = 4000
ENOUGH_ROBOTS = 3  # below which robots are not resampled
PARAMETERS = ("friction", "mass", "gain")
Rows = list[dict[str, Any]]


@dataclass(frozen=True)
class Findings:
    """What the notebook holds of a plan, by contestant."""

    plan: Plan
    notebook: Notebook

    @property
    def robots(self) -> list[int]:
        """Numbers."""
        return [robot for robot, _ in self.plan.robots]

    def result(self, stage: str, task: str, robot: int, name: str) -> Result | None:
        """A piece's result, or that of the contestant that it is the same as; None where it is not there."""
        found = self.notebook.get(stage, task, robot, name)
        if found and "same_as" in found:
            found = self.notebook.get(stage, task, robot, found["same_as"])
        return None if found is None or "left_out" in found else found

    def values(self, task: str, name: str, what: str) -> dict[int, np.ndarray]:
        """Robot -> what its deployments gave, in the order of the scenarios."""
        found = {robot: self.result("deploy", task, robot, name) for robot in self.robots}
        return {robot: np.array(r[what], float) for robot, r in found.items() if r is not None}

    def truth(self, task: str, robot: int) -> dict[str, float]:
        """The robot's own parameters."""
        return (self.notebook.get("collect", task, robot) or {})["truth"]

    def hidden(self, robot: int) -> str:
        """What is hidden in a robot, as far as it is known yet."""
        known = (self.notebook.get("collect", task, robot) for task in self.plan.tasks)
        return next((str(found["truth"]["hidden"]) for found in known if found), "not looked at yet")

    def names(self, task: str) -> list[str]:
        """Contestants that have deployed at least once, the first policy before all."""
        return [n for n in (FIRST, *self.plan.contestants) if self.values(task, n, "returns")]

    def left_out(self) -> list[str]:
        """Why a contestant does not take part, and what each diagnosis said."""
        lines: dict[str, None] = {}
        for robot in self.robots:
            diagnosed = self.notebook.get("diagnose", robot)
            if diagnosed:
                lines[f"robot {robot} (hidden in it: {self.hidden(robot)}): {diagnosed['statement']}"] = None
            for task in self.plan.tasks:
                for name in self.plan.contestants:
                    found = self.notebook.get("infer", task, robot, name) or {}
                    about = f"robot {robot}, {task}, {LABELS[name]}"
                    lines |= {f"{about}: {warning}": None for warning in found.get("warnings", ())}
                    if (self.notebook.get("train", task, robot, name) or {}).get("unchanged"):
                        lines[f"{about}: no moment of the training was better than the first policy, which runs"] = None
                    if "left_out" in found:
                        lines[f"{LABELS[name]} left out: {found['left_out']}"] = None
                    if "same_as" in found:
                        lines[f"robot {robot}: no effect was added, so {LABELS[name]} is {LABELS[WINNER]} there"] = None
        return list(lines)


def interval(parts: Sequence[np.ndarray], rng: np.random.Generator | None = None) -> tuple[float, float]:
    """95 % interval of the mean of values of several robots, by resampling; NaN where there is nothing to resample."""
    rng = rng or np.random.default_rng(0)
    parts = [p[np.isfinite(p)] for p in parts]
    parts = [p for p in parts if len(p)]
    shape = (RESAMPLES, len(parts))
    if len(parts) >= ENOUGH_ROBOTS:
        picked = rng.integers(len(parts), size=shape)
    elif all(len(p) == 1 for p in parts):
        return float("nan"), float("nan")
    else:
        picked = np.broadcast_to(np.arange(len(parts)), shape)
    means = np.empty(shape)
    for i, part in enumerate(parts):
        here = picked == i
        means[here] = part[rng.integers(len(part), size=(here.sum(), len(part)))].mean(axis=1)
    low, high = np.quantile(means.mean(axis=1), (0.025, 0.975))
    return float(low), float(high)


def _over_robots(key: str, each: Sequence[float]) -> dict[str, Any]:
    """Mean and interval of one number of each robot, as entries of a row."""
    low, high = interval([np.array([value], float) for value in each])
    return {key: float(np.mean(each)), f"{key}_low95": low, f"{key}_high95": high}


def performance(findings: Findings, task: str) -> Rows:
    """Tables 4 and 5: return, final inclination and distance of each contestant's policy on the robots."""
    rows = []
    for name in findings.names(task):
        row: dict[str, Any] = {"name": name, "label": LABELS[name]}
        for what, factor, key in (
            ("returns", 1.0, "return"),
            ("final_inclination_deg", 1.0, "inclination_deg"),
            ("distance_m", 100.0, "distance_cm"),
            ("divergence", 1.0, "divergence_nats"),
        ):
            parts = [factor * v for v in findings.values(task, name, what).values()]
            pooled = np.concatenate(parts)
            row |= {key: float(np.nanmean(pooled)), f"{key}_sd": float(np.nanstd(pooled, ddof=1))}
            row[f"{key}_low95"], row[f"{key}_high95"] = interval(parts)
        rows.append(row | {"robots": len(parts), "rollouts": len(pooled)})
    return rows


def comparisons(findings: Findings, task: str, rival: str = WINNER) -> Rows:
    """Table 6: Welch's t-test of each contestant against one, of return and divergence, with Holm's correction.

    Only robots that both have deployed on count. `gain` is the rival's mean return minus the contestant's.
    """
    ours = {what: findings.values(task, rival, what) for what in ("returns", "divergence")}
    rows: Rows = []
    for name in findings.names(task):
        if name == rival or not ours["returns"]:
            continue
        row: dict[str, Any] = {"name": name, "label": LABELS[name], "rival": LABELS[rival]}
        for what in ours:
            theirs = findings.values(task, name, what)
            both = sorted(set(theirs) & set(ours[what]))
            if not both:
                continue
            a, b = (np.concatenate([side[robot] for robot in both]) for side in (ours[what], theirs))
            row[f"p_{what}"] = float(ttest_ind(a, b, equal_var=False, nan_policy="omit").pvalue)
            differences = [ours[what][robot] - theirs[robot] for robot in both]
            low, high = interval(differences)
            row |= {f"gain_{what}": float(np.nanmean(np.concatenate(differences))), "robots": len(both)}
            row |= {f"gain_{what}_low95": low, f"gain_{what}_high95": high}
        rows.append(row)
    for what in ("returns", "divergence"):
        _holm(rows, f"p_{what}")
    return rows


def _holm(rows: Rows, key: str) -> None:
    """Beside each p value the one that is corrected for how many comparisons there are (Holm)."""
    order = sorted((r for r in rows if key in r), key=lambda r: r[key])
    least = 0.0
    for rank, row in enumerate(order):
        least = max(least, min(1.0, row[key] * (len(order) - rank)))
        row[f"{key}_holm"] = least


def effect_gain(findings: Findings, task: str) -> dict[str, Any] | None:
    """Beyond the paper: the return with the diagnosed effect in the model against without, where one was named.

    `right` counts the robots whose effect it is.
    """
    with_effect, without = findings.values(task, EFFECT, "returns"), findings.values(task, WINNER, "returns")
    found = [r for r in findings.robots if (findings.notebook.get("diagnose", r) or {}).get("model")]
    both = [r for r in found if r in with_effect and r in without]
    if not both:
        return None
    parts = [with_effect[r] - without[r] for r in both]
    low, high = interval(parts)
    means = {
        "with": np.mean([with_effect[r].mean() for r in both]),
        "without": np.mean([without[r].mean() for r in both]),
    }
    return {
        "robots": len(both),
        "right": sum(_is_hidden(findings, robot) for robot in both),
        **means,
        "gain": float(np.mean([p.mean() for p in parts])),
        "low95": low,
        "high95": high,
    }


def _is_hidden(findings: Findings, robot: int) -> bool:
    named = (findings.notebook.get("diagnose", robot) or {})["effects"][0]
    return bool(named.partition(":")[0] == findings.hidden(robot))


def variance_reduction(findings: Findings, task: str) -> Rows:
    """Table 3: how much less variance than the prior, and beyond it the error of the mean as a share of the truth."""
    rows = []
    for name in findings.plan.contestants:
        found = {robot: findings.result("infer", task, robot, name) for robot in findings.robots}
        usable = {robot: r for robot, r in found.items() if r is not None}
        for parameter in PARAMETERS if usable else ():
            reductions, errors, inside = [], [], []
            effective = [r["ess"] for r in usable.values()]
            for robot, r in usable.items():
                e = next(e for e in r["estimates"] if e["name"] == parameter)
                truth = findings.truth(task, robot)[parameter]
                reductions.append(1 - e["variance_ratio"])
                errors.append(abs(e["mean"] - truth) / truth)
                inside.append(e["low90"] <= truth <= e["high90"])
            rows.append({
                "name": name, "label": LABELS[name], "parameter": parameter, "robots": len(usable),
                **_over_robots("variance_reduction", reductions), **_over_robots("relative_error", errors),
                "truth_in_90": int(np.sum(inside)), "ess": float(np.mean(effective)),
            })  # fmt: skip
    return rows


def seconds(findings: Findings, task: str) -> Rows:
    """Figure 11: wall time of a generation of each method, the mean over robots of each robot's median."""
    rows = []
    for name in findings.plan.contestants:
        found = [findings.result("infer", task, robot, name) for robot in findings.robots]
        each = [_generation_s(r) for r in found if r]
        if each:
            rows.append({"name": name, "label": LABELS[name], "robots": len(each), **_over_robots("seconds", each)})
    return rows


def _generation_s(inferred: Result) -> float:
    """Median wall time of a generation; where none was timed by itself, that of the run over their number."""
    timed = [g["wall_s"] for g in inferred["generations"] if "wall_s" in g]
    return float(np.median(timed)) if timed else inferred["seconds"] / max(1, len(inferred["generations"]))


def noise(findings: Findings, task: str) -> Rows:
    """Figures 12 and 13: returns under noise on what the policy sees."""
    rows = []
    for name in findings.plan.contestants:
        for sigma in findings.plan.noise:
            found = [findings.result("noise", task, robot, name) for robot in findings.robots]
            parts = [np.array(r["returns"][f"{sigma:g}"], float) for r in found if r]
            if parts:
                low, high = interval(parts)
                pooled = np.concatenate(parts)
                rows.append({
                    "name": name, "label": LABELS[name], "sigma": sigma, "return": float(np.nanmean(pooled)),
                    "return_sd": float(np.nanstd(pooled)), "low95": low, "high95": high, "rollouts": len(pooled),
                })  # fmt: skip
    return rows


def progress(findings: Findings, task: str) -> Rows:
    """Figures 6 to 8: error of the mean (share of the truth, signed) and variance (over the prior's) by generation.

    The mean itself, averaged over robots of different truths, would say little. A robot whose inference has ended stays
    where it was. `*_each` are the robots' own values.
    """
    rows: Rows = []
    for name in findings.plan.contestants:
        found = {robot: findings.result("infer", task, robot, name) for robot in findings.robots}
        runs = {robot: r["generations"] for robot, r in found.items() if r and r["generations"]}
        for i, parameter in enumerate(PARAMETERS if runs else ()):
            truths = np.array([findings.truth(task, robot)[parameter] for robot in runs])
            for t in range(max(map(len, runs.values()))):
                now = [run[min(t, len(run) - 1)] for run in runs.values()]
                error = (np.array([g["mean"][i] for g in now]) - truths) / truths
                ratio = np.array([g["variance_ratio"][i] for g in now])
                rows.append({
                    "name": name, "label": LABELS[name], "parameter": parameter, "generation": t + 1,
                    "robots": len(runs), "error_each": error.tolist(), "variance_ratio_each": ratio.tolist(),
                    **_over_robots("error", error.tolist()), **_over_robots("variance_ratio", ratio.tolist()),
                })  # fmt: skip
    return rows


def times(findings: Findings) -> Rows:
    """What each stage took (wall_s), by task; the diagnosis serves all tasks."""
    rows: dict[tuple[str, str], dict[str, Any]] = {}
    for piece in findings.plan.pieces():
        stage, task = piece[0], piece[1] if len(piece) > 2 else ""
        empty = {"stage": stage, "task": task, "pieces": 0, "done": 0, "wall_s": 0.0}
        row, found = rows.setdefault((task, stage), empty), findings.notebook.get(*piece)
        row["pieces"] += 1
        row["done"] += found is not None
        row["wall_s"] += (found or {}).get("wall_s", 0.0)
    return sorted(rows.values(), key=lambda row: row["task"])


def took(rows: Rows) -> str:
    """The total of these, in a sentence."""
    done, pieces = (sum(row[key] for row in rows) for key in ("done", "pieces"))
    minutes = sum(row["wall_s"] for row in rows) / 60
    return f"{done} of {pieces} pieces of work are done; together they took {minutes:.1f} minutes."


def everything(findings: Findings) -> dict[str, Any]:
    """All tables of all tasks, for the JSON."""
    tasks = {
        task: {
            "performance": performance(findings, task),
            "comparisons": comparisons(findings, task),
            "effect": effect_gain(findings, task),
            "variance_reduction": variance_reduction(findings, task),
            "progress": progress(findings, task),
            "seconds": seconds(findings, task),
            "noise": noise(findings, task),
        }
        for task in findings.plan.tasks
    }
    spent = times(findings)
    return {
        "robots": findings.robots,
        "tasks": tasks,
        "notes": findings.left_out(),
        "times": spent,
        "took": took(spent),
    }
