"""What many inferences of known truths say together: errors, coverage, calibration, and TCBI against the others."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.stats import kstest

from tcbi_bringup.commands.bench import figure

Result = dict[str, Any]
Row = dict[str, Any]
TARGET_ERROR = {"friction": 0.06, "mass": 0.08, "gain": 0.10}  # TCBI's in `AIMED`, where the model can be right
AIMED = {"task": "forward", "rollouts": 20, "noise": 0}
TARGET_COVERAGE = (0.85, 0.95)  # TCBI's, where the model can be right
TARGET_NOISE = 1.25  # error with noise over error without
TARGET_SAID = 0.9  # share of hidden effects after which TCBI calls the model wrong, as the benchmark `hidden` flags
ALIKE = 1.05  # times the simulated rollouts of another method, up to which its budget counts as equal
PAPER = 50 * 15 * 20  # rollouts that Algorithm 1 simulates with Table 2's values
TARGET_BUDGET = 0.2  # of those, TCBI's
FLAT_SD = 12**-0.5  # of a flat prior, in shares of its range
RESAMPLES = 2000
TCBI = "calibrated"


def figures(found: list[Result]) -> list[Row]:
    """Rows of every group of equal cases, then with noise against without, and TCBI against each other method."""
    failed = [r for r in found if "failed" in r]
    rows = [figure("inferences that failed", len(failed), "1", most=0)] if failed else []
    groups = grouped([r for r in found if "failed" not in r])
    for name, group in groups.items():
        rows += _of(name, group)
    for name, group in groups.items():
        case = group[0]["case"]
        quiet = groups.get(title({**case, "noise": 0}), [])
        if case["noise"]:
            most = TARGET_NOISE if case["method"] == TCBI else None
            rows += _ratio(f"{name}: error over that without noise", group, quiet, most)
        for own in groups.values() if case["method"] != TCBI else ():
            if _comparable(own[0]["case"], case):
                equal = within_budget(own, group)
                words = f"{name}: {TCBI}'s error over its{_differing(own, group)}"
                rows += _ratio(words, own, group, 1.0 if equal or _is_the_papers(case) else None)
                rows += _spent(own) if _is_the_papers(case) else []
    return rows


def budget(case: dict[str, Any]) -> tuple[int, int]:
    """Particles and generations."""
    return case["particles"], case["generations"]


def simulated(group: list[Result]) -> float:
    """Rollouts that an inference simulated, in the mean."""
    return float(np.mean([r["simulations"] for r in group]))


def within_budget(own: list[Result], group: list[Result]) -> bool:
    """Whether TCBI simulated no more than the other method; there is no target where it did."""
    return simulated(own) <= ALIKE * simulated(group)


def _is_the_papers(case: dict[str, Any]) -> bool:
    """Whether it is Algorithm 1 with the budget of Table 2."""
    return case["method"] == "paper" and case["particles"] * case["generations"] * case["rollouts"] == PAPER


def _spent(own: list[Result]) -> list[Row]:
    """What TCBI simulated for an inference, beside the paper's."""
    share = simulated(own) / PAPER
    words = f"{title(own[0]['case'])}: simulated rollouts over the paper's {PAPER:,}"
    return [figure(words, share, "1", most=TARGET_BUDGET)]


def _comparable(own: dict[str, Any], case: dict[str, Any]) -> bool:
    """Whether one is of TCBI and both infer from the same, with equal values of the settings that both methods have."""
    alike = ("source", "task", "rollouts", "duration", "noise", "bins", "loop")
    same = all(own.get(key) == case.get(key) for key in alike)
    mine, theirs = dict(own["settings"]), dict(case["settings"])
    return own["method"] == TCBI and same and all(mine[key] == theirs[key] for key in mine.keys() & theirs.keys())


def _differing(own: list[Result], group: list[Result]) -> str:
    """What TCBI was given otherwise: settings, and a budget with the rollouts that both simulated for an inference."""
    mine, theirs = own[0]["case"], group[0]["case"]
    words = [f", {name}={value:g}" for name, value in mine["settings"] if name not in dict(theirs["settings"])]
    if budget(mine) != budget(theirs) or not within_budget(own, group):
        spent = f"{simulated(own):.0f} simulated rollouts to {simulated(group):.0f}"
        words.append(f", {mine['particles']} x {mine['generations']}: {spent}")
    return "".join(words)


def rank(result: Result, i: int) -> float:
    """Of the truth of parameter i among the effective particles, drawn evenly from between its neighbours.

    Without that draw the ranks of few particles have steps, which are not uniform however right they are.
    """
    ess = result["ess"]
    within = np.random.default_rng([result["case"]["truth"], i]).random()
    return float((ess * result["parameters"][i]["rank"] + within) / (ess + 1))


def grouped(found: list[Result]) -> dict[str, list[Result]]:
    """By everything but the truth's number."""
    groups: dict[str, list[Result]] = {}
    for result in found:
        groups.setdefault(title(result["case"]), []).append(result)
    return groups


def title(case: dict[str, Any]) -> str:
    """What a group is called."""
    words = [case["source"], case["task"], f"{case['rollouts']} x {case['duration']:g} s"]
    words.append(f"{case['particles']} x {case['generations']}")
    words += [f"noise {case['noise']:g}"] if case["noise"] else []
    words += [f"{case['bins']} bins"] if case["bins"] != 20 else []
    words += [f"loop {case['loop']}"] if case.get("loop") else []
    words += [f"{name}={value:g}" for name, value in case["settings"]]
    return f"{', '.join(words)}: {case['method']}"


def _of(name: str, group: list[Result]) -> list[Row]:
    n, rows = len(group), []
    case = group[0]["case"]
    right = case["method"] == TCBI and case["source"] != "hidden"
    aimed = right and all(case[key] == value for key, value in AIMED.items())
    for i, p in enumerate(group[0]["parameters"]):
        mine = [r["parameters"][i] for r in group]
        value, unit = error(mine)
        target = TARGET_ERROR.get(p["name"]) if aimed else None
        rows.append(figure(f"{name}: RMSE of {p['name']}, {n} truths", value, unit, most=target))
        rows.append(figure(f"{name}: error of {p['name']} over the prior's", relative_error(mine), "1"))
    if case["method"] in ("prior", "bayesopt"):
        return rows
    every = [p for r in group for p in r["parameters"]]
    rows.append(
        figure(
            f"{name}: 90 % intervals that hold the truth, of {len(every)}",
            coverage(every),
            "1",
            *(TARGET_COVERAGE[: 2 if case["source"] == "model" else 1] if right else ()),
        )
    )
    rows += [
        figure(
            f"{name}: 90 % intervals of {group[0]['parameters'][i]['name']} that hold the truth, of {n}",
            coverage([r["parameters"][i] for r in group]),
            "1",
        )
        for i in range(len(group[0]["parameters"]))
    ]
    if case["source"] == "model":  # of robots that are not drawn from the prior no ranks are uniform
        names = [p["name"] for p in group[0]["parameters"]]
        values = holm([kstest([rank(r, i) for r in group], "uniform").pvalue for i in range(len(names))])
        rows += [
            figure(f"{name}: p-value of uniform ranks of {p}, by Holm for {len(names)}", value, "1")
            for p, value in zip(names, values, strict=True)
        ]
    rows.append(
        figure(
            f"{name}: width of posteriors over the prior's",
            float(np.mean([p["unit_sd"] for p in every])) / FLAT_SD,
            "1",
        )
    )
    said = float(np.mean([r["says_misfit"] or r["says_outside"] for r in group]))
    must = TARGET_SAID if case["method"] == TCBI and case["source"] == "hidden" else None
    rows.append(figure(f"{name}: inferences that call the model wrong, of {n}", said, "1", least=must))
    if all("says_untold" in r for r in group):  # results of before it was kept lack it
        untold = float(np.mean([r["says_untold"] for r in group]))
        rows.append(figure(f"{name}: inferences that cannot tell whether the model is wrong, of {n}", untold, "1"))
    told = float(np.mean([p["identified"] for p in every]))
    rows.append(figure(f"{name}: parameters that the data are said to tell, of {len(every)}", told, "1"))
    rows.append(figure(f"{name}: processor time", float(np.mean([r["cpu_s"] for r in group])), "s"))
    return rows


def holm(p_values: Sequence[float]) -> list[float]:
    """Each of several p-values, corrected by Holm's method so that one below a level is as rare as a single one."""
    n, corrected, highest = len(p_values), [0.0] * len(p_values), 0.0
    for k, i in enumerate(np.argsort(p_values)):
        highest = max(highest, min(1.0, (n - k) * float(p_values[i])))
        corrected[i] = highest
    return corrected


def _ratio(words: str, over: list[Result], under: list[Result], most: float | None) -> list[Row]:
    """Ratio of root mean squared errors on truths that both groups have, with a bootstrap interval."""
    theirs = {r["case"]["truth"]: squares(r) for r in under}
    pairs = np.array([(squares(r), theirs[r["case"]["truth"]]) for r in over if r["case"]["truth"] in theirs])
    if len(pairs) < 2:
        return []
    picked = np.random.default_rng(0).integers(len(pairs), size=(RESAMPLES, len(pairs)))
    sums = pairs[picked].sum(axis=1)
    ratios = np.sqrt(sums[:, 0] / np.maximum(sums[:, 1], 1e-12))
    low, high = np.quantile(ratios, [0.05, 0.95])
    value = float(np.sqrt(pairs[:, 0].sum() / max(pairs[:, 1].sum(), 1e-12)))
    return [figure(f"{words}, {len(pairs)} truths, 90 % {low:.2f} to {high:.2f}", value, "1", most=most)]


def squares(result: Result) -> float:
    """Mean squared error of all parameters, in shares of the priors' ranges."""
    return float(np.mean([p["unit_error"] ** 2 for p in result["parameters"]]))


def error(mine: list[dict[str, Any]]) -> tuple[float, str]:
    """Root mean squared error; relative for the gain, whose scale is logarithmic."""
    truth, center = (np.array([p[key] for p in mine]) for key in ("truth", "center"))
    if mine[0]["name"] == "gain":
        return float(np.sqrt(np.mean(np.log(center / truth) ** 2))), "relative"
    return float(np.sqrt(np.mean((center - truth) ** 2))), "kg" if mine[0]["name"] == "mass" else "1"


def relative_error(mine: list[dict[str, Any]]) -> float:
    """Root mean squared error over that of the prior's mean on the same truths."""
    errors = np.array([p["unit_error"] for p in mine])
    truths = np.array([p["unit_truth"] for p in mine])
    return float(np.sqrt(np.mean(errors**2) / max(np.mean((truths - 0.5) ** 2), 1e-12)))


def coverage(mine: list[dict[str, Any]]) -> float:
    """Share of 90 % intervals that hold the truth."""
    return float(np.mean([p["low90"] <= p["truth"] <= p["high90"] for p in mine]))
