"""The study's tables and page: they say what the rollouts say, and how sure that is."""

import dataclasses
import functools
import json
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from tcbi_bringup.study import tables
from tcbi_bringup.study.notebook import Notebook
from tcbi_bringup.study.page import _short, generations, write
from tcbi_bringup.study.plan import EFFECT, FIRST, WINNER, Plan, TaskPlan

TINY = Plan(
    {"balance": TaskPlan("balance-early", 2, 10, 1, 1280, 2, 1)}, ((11, "strong"),), ("fixed_dr", WINNER), (0.05,)
)


def invented(folder: Path, gain: float) -> tables.Findings:
    """Deployments of two contestants on four robots, the second one better by `gain` on average."""
    rng = np.random.default_rng(0)
    plan = Plan({"balance": TINY.tasks["balance"]}, tuple((r, "strong") for r in range(4)), ("fixed_dr", WINNER))
    notebook = Notebook(folder / "study.jsonl")
    for robot in range(4):
        for name, mean in (("fixed_dr", 400.0), (WINNER, 400.0 + gain)):
            others = {what: rng.random(30) for what in ("final_inclination_deg", "distance_m", "divergence")}
            deployed = {"returns": rng.normal(mean, 100.0, 30), **others}
            notebook.once(("deploy", "balance", robot, name), functools.partial(dict, deployed))
    return tables.Findings(plan, notebook)


def test_a_difference_shows_in_welchs_test_and_in_the_interval(tmp_path: Path) -> None:
    (row,) = tables.comparisons(invented(tmp_path, 60.0), "balance")
    assert row["p_returns"] < 1e-3 and row["gain_returns_low95"] > 0 and row["robots"] == 4
    assert row["gain_returns_low95"] < row["gain_returns"] < row["gain_returns_high95"]


def test_where_there_is_no_difference_none_is_claimed(tmp_path: Path) -> None:
    (row,) = tables.comparisons(invented(tmp_path, 0.0), "balance")
    assert row["p_returns"] > 0.05 and row["gain_returns_low95"] < 0 < row["gain_returns_high95"]


def test_pieces_of_several_versions_of_the_code_are_told(tmp_path: Path, monkeypatch) -> None:
    findings = invented(tmp_path, 0.0)
    assert findings.mixed() == []
    monkeypatch.setattr("tcbi_bringup.study.notebook._code", lambda: "another")
    findings.notebook.once(("deploy", "balance", 0, FIRST), lambda: {"returns": [1.0]})
    (line,) = findings.mixed()
    assert "2 versions of the code" in line


def test_only_who_stands_on_all_robots_is_ranked_and_the_others_are_told_on_their_own(tmp_path: Path) -> None:
    findings = invented(tmp_path, 60.0)
    findings.notebook._found.pop(("deploy", "balance", 3, "fixed_dr"))
    data = {"tasks": {"balance": {
        "performance": tables.performance(findings, "balance"), "comparisons": tables.comparisons(findings, "balance"),
        "effect": None,
    }}}  # fmt: skip
    ranked, beside, _ = _short(findings, data)
    assert "fixed" not in ranked
    assert "against fixed randomisation (3 of 4 robots) on the same robots: +" in beside


def with_the_effect(folder: Path, hidden: dict, named: str = "weak_leg:lf", gain: float = 50.0) -> tables.Findings:
    """Five robots, on three of which an effect was added to the model; there the return is higher by `gain`."""
    rng = np.random.default_rng(0)
    plan = Plan({"balance": TINY.tasks["balance"]}, tuple((r, "strong") for r in range(5)), (WINNER, EFFECT))
    notebook = Notebook(folder / "study.jsonl")
    for robot in range(5):
        deployed = {what: rng.random(30) for what in ("final_inclination_deg", "distance_m", "divergence")}
        deployed["returns"] = rng.normal(400.0, 20.0, 30)
        better = deployed | {"returns": deployed["returns"] + gain + rng.normal(0.0, 5.0)}
        found = {"same_as": WINNER} if robot > 2 else better
        notebook.once(
            ("diagnose", robot), functools.partial(dict, effects=[named], model="v1", statement="it is there")
        )
        notebook.once(("collect", "balance", robot), lambda: {"truth": hidden})
        notebook.once(("deploy", "balance", robot, WINNER), functools.partial(dict, deployed))
        notebook.once(("deploy", "balance", robot, EFFECT), functools.partial(dict, found))
    return tables.Findings(plan, notebook)


LAME = {"hidden": "weak_leg", "effect": {"leg": "lf"}}


def test_the_effect_is_compared_only_on_the_robots_where_it_was_added(tmp_path: Path) -> None:
    findings = with_the_effect(tmp_path, LAME)
    (row,) = tables.comparisons(findings, "balance")
    gain = tables.effect_gain(findings, "balance")
    assert row["robots"] == gain["robots"] == 3 and row["label"] == "TCBI with the effect (3 of 5 robots)"
    assert row["gain_returns"] == pytest.approx(-gain["gain"]) and gain["gain"] == pytest.approx(50.0, abs=10.0)
    assert row["gain_returns_high95"] < 0, "no zeros of robots without an effect widen it"
    shown = {r["name"]: r for r in tables.performance(findings, "balance")}
    assert shown[EFFECT]["rollouts"] == 90 and shown[WINNER]["rollouts"] == 150
    page = write(findings, tmp_path / "study.html").read_text()
    assert "also had the recordings of the diagnosis, 7 motions of 2.2 s from each robot" in page


def test_an_effect_at_the_wrong_place_is_not_the_one_that_is_hidden(tmp_path: Path) -> None:
    for i, (hidden, named, right) in enumerate(
        (
            (LAME, "weak_leg:lf", 3),
            (LAME, "weak_leg:rm", 0),
            ({"hidden": "joint_offset", "effect": {"joint": "lf_coxa"}}, "joint_offset:lf_coxa", 3),
            ({"hidden": "payload", "effect": {"mass_kg": 0.2}}, "payload", 3),
        )
    ):
        (tmp_path / str(i)).mkdir()
        assert tables.effect_gain(with_the_effect(tmp_path / str(i), hidden, named), "balance")["right"] == right


TRUTH = {"friction": 0.5, "mass": 2.0, "gain": 10.0}  # of the first robot; every further one has 1.5 times as much


def inferred(folder: Path, robots: int) -> tables.Findings:
    """Two generations of one method, and the prior: means 20 % too large, then 10 % +- 1 % by robot."""
    folder.mkdir(exist_ok=True)
    plan = Plan({"balance": TINY.tasks["balance"]}, tuple((r, "strong") for r in range(robots)), ("fixed_dr", WINNER))
    notebook = Notebook(folder / "study.jsonl")
    for robot in range(robots):
        truth = np.array(list(TRUTH.values())) * 1.5**robot
        share = 1.1 + 0.01 * (-1) ** robot
        runs = [
            {"mean": 1.2 * truth, "variance_ratio": [0.6] * 3},
            {"mean": share * truth, "variance_ratio": [0.3] * 3},
        ]
        ends = [
            {"name": name, "mean": share * t, "low90": 0.9 * t, "high90": (1.3 if robot else 0.95) * t,
             "variance_ratio": 0.3 + 0.1 * robot}
            for name, t in zip(TRUTH, truth, strict=True)
        ]  # fmt: skip
        notebook.once(("collect", "balance", robot), lambda t=truth: {"truth": dict(zip(TRUTH, t, strict=True))})
        for name, history in (("fixed_dr", runs[:1]), (WINNER, runs)):
            found = {"seconds": 6.0 + robot, "generations": history, "estimates": ends, "ess": 20.0}
            notebook.once(("infer", "balance", robot, name), functools.partial(dict, found))
    return tables.Findings(plan, notebook)


def test_curves_show_the_distance_from_each_robots_own_truth_with_an_interval_over_robots(tmp_path: Path) -> None:
    rows = [r for r in tables.progress(inferred(tmp_path, 4), "balance") if r["name"] == WINNER]
    assert len(rows) == 2 * len(tables.PARAMETERS)
    for row in rows:
        assert row["error"] == pytest.approx({1: 0.2, 2: 0.1}[row["generation"]])
        assert row["variance_ratio"] == pytest.approx({1: 0.6, 2: 0.3}[row["generation"]])
        width = row["error_high95"] - row["error_low95"]
        assert row["error_low95"] <= row["error"] <= row["error_high95"]
        half = 3.182 * 0.02 / np.sqrt(12)  # Student's with three degrees of freedom, of +- 1 %
        assert width == pytest.approx(2 * half if row["generation"] == 2 else 0.0, rel=1e-3, abs=1e-9)


def test_the_reduction_of_variance_has_an_interval_over_robots_and_none_with_two(tmp_path: Path) -> None:
    many, few = inferred(tmp_path / "many", 4), inferred(tmp_path / "few", 2)
    row = next(r for r in tables.variance_reduction(many, "balance") if r["name"] == WINNER)
    assert row["variance_reduction"] == pytest.approx(0.55) and row["truth_in_90"] == 3 and row["robots"] == 4
    assert row["variance_reduction_low95"] == pytest.approx(0.3446, abs=1e-3)  # 0.55 - 3.182 * 0.1291 / 2
    assert row["variance_reduction_high95"] == pytest.approx(0.7554, abs=1e-3)
    assert row["relative_error_low95"] < row["relative_error"] < row["relative_error_high95"]
    row = next(r for r in tables.variance_reduction(few, "balance") if r["name"] == WINNER)
    assert np.isnan(row["variance_reduction_low95"]) and np.isnan(row["relative_error_high95"])


def test_the_time_of_a_generation_is_the_median_of_those_that_were_timed(tmp_path: Path) -> None:
    notebook = Notebook(tmp_path / "study.jsonl")
    found = tables.Findings(dataclasses.replace(TINY, contestants=("abc", "simopt", WINNER)), notebook)
    timed = [{"wall_s": 2.0}, {"wall_s": 3.0}, {"wall_s": 40.0}]
    for name, generations_of in (("abc", timed), ("simopt", [{}, *timed]), (WINNER, [{}, {}])):
        result = {"seconds": 5.0, "generations": generations_of}  # what the last of several runs took
        notebook.once(("infer", "balance", 11, name), functools.partial(dict, result))
    assert [row["seconds"] for row in tables.seconds(found, "balance")] == [3.0, 3.0, 2.5]


def test_the_report_says_what_every_stage_took_and_the_total_of_this_plan(tmp_path: Path) -> None:
    pieces = list(TINY.pieces())
    lines = [{"key": key, "result": {"wall_s": 60.0 * (i + 1)}} for i, key in enumerate(pieces[:-1])]
    lines.append({"key": ("train", "balance", 99, WINNER), "result": {"wall_s": 1e6}})  # a robot of another plan
    (tmp_path / "study.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    findings = tables.Findings(TINY, Notebook(tmp_path / "study.jsonl"))
    rows = {row["stage"]: row for row in tables.times(findings)}
    assert list(rows) == ["collect", "deploy", "infer", "train", "noise"]
    for stage, row in rows.items():
        mine = [i for i, piece in enumerate(pieces) if piece[0] == stage]
        assert row["pieces"] == len(mine) and row["done"] == len(mine) - (stage == "noise")
        assert row["wall_s"] == 60.0 * sum(i + 1 for i in mine if i + 1 < len(pieces))
    done = len(pieces) - 1
    total = f"{done} of {done + 1} pieces of work are done; together they took {done * (done + 1) / 2:.1f} minutes"
    assert total in tables.took(list(rows.values()))


def test_the_page_draws_a_band_over_three_robots_and_each_robot_where_there_are_fewer(tmp_path: Path) -> None:
    for robots, bands in ((4, True), (2, False)):
        findings = inferred(tmp_path / str(robots), robots)
        rows = [r for r in tables.progress(findings, "balance") if r["parameter"] == "mass"]
        assert ("FillBetween" in generations(rows, "error", "axis")) == bands
        page = write(findings, tmp_path / str(robots) / "study.html").read_text()
        drawn = tmp_path / str(robots) / "figures" / "balance_mass_error.svg"
        assert ElementTree.parse(drawn).getroot().tag.endswith("svg"), "a file of its own, that a browser shows"
        assert "(mean − truth) / truth of mass" in page and "nan" not in page
        assert "What it took" in page and f"{3 * robots} of" in page


@pytest.mark.parametrize(("robots", "rollouts"), [(3, 1), (8, 1), (3, 5), (8, 5), (1, 3), (2, 30)])
def test_intervals_cover_as_often_as_they_say(robots: int, rollouts: int) -> None:
    """Of normal values, within four standard errors of 2000 trials: a false alarm in one of 16000 runs of a case."""
    rng = np.random.default_rng(1)
    level = rng.normal(0.0, 1.0 if robots > 2 else 0.0, (2000, robots, 1))  # of few robots, their own mean is meant
    ends = np.array([tables.interval(list(each)) for each in rng.normal(level, 0.5, (2000, robots, rollouts))])
    covered = np.mean((ends[:, 0] < 0) & (ends[:, 1] > 0))
    assert covered == pytest.approx(0.95, abs=4 * np.sqrt(0.95 * 0.05 / 2000))


def test_there_is_no_interval_of_fewer_than_three_values() -> None:
    for few in ([], [[1.0], [2.0]], [[1.0, 3.0]], [[1.0, np.nan], [2.0, 3.0], [np.nan]]):
        assert np.isnan(tables.interval([np.array(part) for part in few])).all()
    assert tables.interval([np.full(3, 2.0)] * 2) == (2.0, 2.0)


def test_holms_correction_is_the_textbooks() -> None:
    rows = [{"p": p} for p in (0.01, 0.04, 0.03)]
    tables._holm(rows, "p")
    assert [r["p_holm"] for r in rows] == pytest.approx([0.03, 0.06, 0.06])


def test_holms_correction_leaves_out_what_is_not_known() -> None:
    rows: tables.Rows = [{"p": p} for p in (float("nan"), 0.001, 0.02)]
    tables._holm(rows, "p")
    assert [r["p_holm"] for r in rows] == pytest.approx([float("nan"), 0.002, 0.02], nan_ok=True)
