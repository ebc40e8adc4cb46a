"""From what was found to the paper's Tables 3 to 6, as plain data.

Every row says on how many robots and rollouts it stands: those on which a contestant has results of its own. Intervals
are 95 %, Student's t on the robots' means (three or more); with fewer robots they come from the scatter of the rollouts
on each and speak of these robots alone, and the tables say so. What an inference gives is one number for each robot:
with fewer than three there is no interval (NaN).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import stdtrit
from scipy.stats import ttest_ind

from tcbi_bringup.study.notebook import Notebook, Result
from tcbi_bringup.study.plan import EFFECT, FIRST, LABELS, WINNER, Plan
from tcbi_contract.wording import counted

ENOUGH = 3  # robots for an interval over robots, rollouts on each for one within them
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
        """A piece's own result; None where it is not there, or another contestant's."""
        found = self.notebook.get(stage, task, robot, name)
        return None if found is None or {"left_out", "same_as"} & set(found) else found

    def values(self, task: str, name: str, what: str) -> dict[int, np.ndarray]:
        """Robot -> what its deployments gave, in the order of the scenarios."""
        found = {robot: self.result("deploy", task, robot, name) for robot in self.robots}
        return {robot: np.array(r[what], float) for robot, r in found.items() if r is not None}

    def truth(self, task: str, robot: int) -> dict[str, float]:
        """The robot's own parameters."""
        return (self.notebook.get("collect", task, robot) or {})["truth"]

    def hidden(self, robot: int) -> str:
        """What is hidden in a robot, "name" or "name:site" as a diagnosis names it, as far as it is known yet."""
        for task in self.plan.tasks:
            found = self.notebook.get("collect", task, robot) or {}
            if "truth" in found:
                effect = found["truth"]["effect"]
                site = effect.get("leg") or effect.get("joint")
                return f"{found['truth']['hidden']}{f':{site}' if site else ''}"
        return "not looked at yet"

    def named(self, robot: int) -> str:
        """The effect that the diagnosis of a robot added to the model; "" where there is none."""
        return next(iter((self.notebook.get("diagnose", robot) or {}).get("effects", ())), "")

    def label(self, name: str, robots: int) -> str:
        """A contestant's label, with the number of robots that a row stands on where it is not all."""
        total = len(self.robots)
        return LABELS[name] + (f" ({robots} of {counted(total, 'robot')})" if robots < total else "")

    def names(self, task: str) -> list[str]:
        """Contestants that have deployed at least once, the first policy before all."""
        return [n for n in (FIRST, *self.plan.contestants) if self.values(task, n, "returns")]

    def left_out(self) -> list[str]:
        """Why a contestant does not take part, and what each diagnosis said."""
        lines = dict.fromkeys(self._missing())
        told: dict[str, dict[str, None]] = {}  # where each warning was given
        for robot in self.robots:
            diagnosed = self.notebook.get("diagnose", robot)
            if diagnosed and "statement" in diagnosed:
                lines[f"robot {robot} (hidden in it: {self.hidden(robot)}): {diagnosed['statement']}"] = None
            for task in self.plan.tasks:
                for name in self.plan.contestants:
                    found = self.notebook.get("infer", task, robot, name) or {}
                    about = f"robot {robot}, {task}, {LABELS[name]}"
                    for warning in found.get("warnings", ()):
                        told.setdefault(warning, {})[about] = None
                    if (self.notebook.get("train", task, robot, name) or {}).get("unchanged"):
                        lines[f"{about}: no moment of the training was better than the first policy, which runs"] = None
                    if "same_as" in found:
                        lines[f"robot {robot}: no effect was added, so {LABELS[name]} is {LABELS[WINNER]} there"] = None
        return [*lines, *(f"{'; '.join(places)}: {warning}" for warning, places in told.items())]

    def mixed(self) -> list[str]:
        """A warning where the pieces come from several versions of the code, whose results may not compare."""
        found = [self.notebook.get(*piece) for piece in self.plan.pieces()]
        versions = {result["code"] for result in found if result and "code" in result}
        if len(versions) < 2:
            return []
        return [
            f"The pieces come from {len(versions)} versions of the code: what differs between methods may differ "
            "between these. A study in a new folder (--out) has one."
        ]

    def _missing(self) -> list[str]:
        places: dict[tuple[str, str], dict[str, None]] = {}
        for piece in self.plan.pieces():
            why = (self.notebook.get(*piece) or {}).get("left_out")
            if why:
                who = LABELS[piece[3]] if len(piece) > 3 else piece[0]
                where = f"robot {piece[2]}, {piece[1]}" if len(piece) > 2 else f"robot {piece[1]}"
                places.setdefault((who, why), {})[where] = None
        return [f"{who} left out ({'; '.join(found)}): {why}" for (who, why), found in places.items()]


def interval(parts: Sequence[np.ndarray]) -> tuple[float, float]:
    """Student's 95 % interval of the mean of values of several robots; NaN where there are too few.

    With fewer than three robots, of these robots' own mean, from the scatter on each (Welch and Satterthwaite).
    """
    parts = [p for p in (p[np.isfinite(p)] for p in parts) if len(p)]
    means = np.array([p.mean() for p in parts])
    if len(parts) >= ENOUGH:
        variance, freedom = means.var(ddof=1) / len(parts), len(parts) - 1.0
    elif parts and min(map(len, parts)) >= ENOUGH:
        shares = np.array([p.var(ddof=1) / len(p) for p in parts]) / len(parts) ** 2
        variance = shares.sum()
        freedom = variance**2 / (shares**2 / [len(p) - 1 for p in parts]).sum() if variance else 1.0
    else:
        return float("nan"), float("nan")
    half = stdtrit(freedom, 0.975) * np.sqrt(variance)
    return float(means.mean() - half), float(means.mean() + half)


def _over_robots(key: str, each: Sequence[float]) -> dict[str, Any]:
    """Mean and interval of one number of each robot, as entries of a row."""
    low, high = interval([np.array([value], float) for value in each])
    return {key: float(np.mean(each)), f"{key}_low95": low, f"{key}_high95": high}


def _sd(values: np.ndarray) -> float:
    """Of those that are finite; NaN where fewer than two are."""
    known = values[np.isfinite(values)]
    return float(known.std(ddof=1)) if len(known) > 1 else float("nan")


def performance(findings: Findings, task: str) -> Rows:
    """Tables 4 and 5: return, final inclination and distance of each contestant's policy on the robots."""
    rows = []
    for name in findings.names(task):
        row: dict[str, Any] = {"name": name}
        for what, factor, key in (
            ("returns", 1.0, "return"),
            ("final_inclination_deg", 1.0, "inclination_deg"),
            ("distance_m", 100.0, "distance_cm"),
            ("divergence", 1.0, "divergence_nats"),
        ):
            parts = [factor * v for v in findings.values(task, name, what).values()]
            pooled = np.concatenate(parts)
            row |= {key: float(np.nanmean(pooled)), f"{key}_sd": _sd(pooled)}
            row[f"{key}_low95"], row[f"{key}_high95"] = interval(parts)
        rows.append(row | {"label": findings.label(name, len(parts)), "robots": len(parts), "rollouts": len(pooled)})
    return rows


def comparisons(findings: Findings, task: str, rival: str = WINNER) -> Rows:
    """Table 6: Welch's t-test of each contestant against one, of return and divergence, with Holm's correction.

    Only robots count that both have deployed on, each with a policy of its own. `gain` is the rival's mean return minus
    the contestant's.
    """
    ours = {what: findings.values(task, rival, what) for what in ("returns", "divergence")}
    rows: Rows = []
    for name in findings.names(task):
        if name == rival or not ours["returns"]:
            continue
        both = sorted(set(findings.values(task, name, "returns")) & set(ours["returns"]))
        if not both:
            continue
        row: dict[str, Any] = {"name": name, "label": findings.label(name, len(both)), "rival": LABELS[rival]}
        row["robots"] = len(both)
        for what in ours:
            theirs = findings.values(task, name, what)
            a, b = (np.concatenate([side[robot] for robot in both]) for side in (ours[what], theirs))
            row[f"p_{what}"] = float(ttest_ind(a, b, equal_var=False, nan_policy="omit").pvalue)
            differences = [ours[what][robot] - theirs[robot] for robot in both]
            low, high = interval(differences)
            row |= {
                f"gain_{what}": float(np.nanmean(np.concatenate(differences))),
                f"gain_{what}_low95": low,
                f"gain_{what}_high95": high,
            }
        rows.append(row)
    for what in ("returns", "divergence"):
        _holm(rows, f"p_{what}")
    return rows


def _holm(rows: Rows, key: str) -> None:
    """Beside each p value the one that is corrected for how many comparisons there are (Holm)."""
    compared = [r for r in rows if key in r]
    for row in compared:
        row[f"{key}_holm"] = float("nan")  # where a p value is not known
    order = sorted((r for r in compared if np.isfinite(r[key])), key=lambda r: r[key])
    least = 0.0
    for rank, row in enumerate(order):
        least = max(least, min(1.0, row[key] * (len(order) - rank)))
        row[f"{key}_holm"] = least


def effect_gain(findings: Findings, task: str) -> dict[str, Any] | None:
    """Beyond the paper: the return with the diagnosed effect in the model against without, where one was named.

    `right` counts the robots whose effect it is, at the place where it is.
    """
    with_effect, without = findings.values(task, EFFECT, "returns"), findings.values(task, WINNER, "returns")
    both = sorted(set(with_effect) & set(without))
    if not both:
        return None
    parts = [with_effect[r] - without[r] for r in both]
    low, high = interval(parts)
    means = {
        "with": np.mean([np.nanmean(with_effect[r]) for r in both]),
        "without": np.mean([np.nanmean(without[r]) for r in both]),
    }
    return {
        "robots": len(both),
        "right": sum(findings.named(robot) == findings.hidden(robot) for robot in both),
        **means,
        "gain": float(np.mean([np.nanmean(p) for p in parts])),
        "gain_low95": low,
        "gain_high95": high,
    }


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
                "name": name, "label": findings.label(name, len(usable)), "parameter": parameter, "robots": len(usable),
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
            label = findings.label(name, len(each))
            rows.append({"name": name, "label": label, "robots": len(each), **_over_robots("seconds", each)})
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
                    "name": name, "label": findings.label(name, len(parts)), "sigma": sigma,
                    "return": float(np.nanmean(pooled)), "return_sd": _sd(pooled),
                    "low95": low, "high95": high, "rollouts": len(pooled),
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
                    "name": name, "label": findings.label(name, len(runs)), "parameter": parameter, "generation": t + 1,
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
        row["done"] += piece in findings.notebook
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
        "notes": [*findings.mixed(), *findings.left_out()],
        "times": spent,
        "took": took(spent),
    }
