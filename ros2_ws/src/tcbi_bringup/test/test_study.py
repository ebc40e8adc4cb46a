"""The study: what is done is kept, what is cut off is done again, and the tables say what the rollouts say."""

import dataclasses
import functools
import json
from pathlib import Path

import numpy as np
import pytest

from tcbi_bringup.errors import BringupError
from tcbi_bringup.study import experiment as pieces_of_work
from tcbi_bringup.study import tables
from tcbi_bringup.study.experiment import Experiment
from tcbi_bringup.study.notebook import Notebook
from tcbi_bringup.study.page import generations, write
from tcbi_bringup.study.plan import CONTESTANTS, EFFECT, FIRST, PRESETS, WINNER, Plan, TaskPlan, chosen
from tcbi_bringup.study.robots import Laboratory
from tcbi_contract.errors import UsageError
from tcbi_infer.baselines.prior import PriorSettings
from tcbi_infer.errors import InferError
from tcbi_infer.tcbi.method import METHODS

TINY = Plan(
    {"balance": TaskPlan("balance-early", 2, 10, 1, 1280, 2, 1)}, ((11, "strong"),), ("fixed_dr", WINNER), (0.05,)
)


def test_a_study_goes_on_where_it_was_and_does_nothing_twice(tmp_path: Path) -> None:
    notebook = Notebook(tmp_path / "study.jsonl")
    assert notebook.once(("train", "balance", 1), lambda: {"x": np.float64(1.5)})["x"] == 1.5
    with (tmp_path / "study.jsonl").open("a") as file:
        file.write('{"key": ["train", "bal')  # the power failed here
    again = Notebook(tmp_path / "study.jsonl")
    assert ("train", "balance", 1) in again and again.get("train", "balance", 1) == notebook.get("train", "balance", 1)
    again.once(("train", "balance", 2), lambda: {"x": 2})
    again.once(("train", "balance", 1), lambda: pytest.fail("done twice"))
    assert [json.loads(line)["key"][-1] for line in (tmp_path / "study.jsonl").read_text().splitlines()] == [1, 2]


def test_a_method_whose_library_is_not_there_is_tried_again_and_one_that_fails_is_not(tmp_path, monkeypatch) -> None:
    def failing(*_: object, **__: object) -> None:
        raise InferError("every simulation diverged")

    plan = dataclasses.replace(TINY, contestants=("bayesopt", WINNER))
    work = Experiment(plan, tmp_path, Laboratory(1), threads=1)
    work.do(("collect", "balance", 11))
    monkeypatch.setattr(pieces_of_work, "find_method", failing)
    assert "not_yet" in work.do(("infer", "balance", 11, "bayesopt"))
    assert "not_yet" in work.do(("train", "balance", 11, "bayesopt"))
    monkeypatch.undo()
    monkeypatch.setattr(pieces_of_work, "infer", failing)
    assert work.do(("infer", "balance", 11, WINNER))["left_out"] == "every simulation diverged"
    kept = Notebook(tmp_path / "study.jsonl")
    assert ("infer", "balance", 11, WINNER) in kept and ("collect", "balance", 11) in kept
    assert not {("infer", "balance", 11, "bayesopt"), ("train", "balance", 11, "bayesopt")} & set(kept._found)


def test_every_contestant_infers_by_a_method_that_there_is_and_needs_only_earlier_pieces() -> None:
    assert {c.method for c in CONTESTANTS.values()} <= set(METHODS)
    for name in PRESETS:
        pieces = list(chosen(name).pieces())
        assert len(set(pieces)) == len(pieces)
        for i, (stage, *rest) in enumerate(pieces):
            if stage == "infer":
                task, robot, method = rest
                earlier = [("collect", task, robot), *([("diagnose", robot)] if method == EFFECT else [])]
                assert set(earlier) <= set(pieces[:i])
            if stage in ("train", "noise") or (stage == "deploy" and rest[-1] != FIRST):
                assert ("infer", *rest) in pieces[:i]


def test_a_part_of_a_preset_can_be_chosen_and_what_is_unknown_is_named() -> None:
    plan = chosen("hour", robots="7,9", tasks="balance", contestants="tcbi,abc")
    assert plan.robots == ((7, "strong"), (9, "strong")) and list(plan.tasks) == ["balance"]
    assert plan.contestants == ("tcbi", "abc")
    for wrong in ({"preset": "day"}, {"robots": "a"}, {"tasks": "dance"}, {"contestants": "magic"}):
        with pytest.raises(UsageError, match=next(iter(wrong.values()))):
            chosen(**{"preset": "hour", **wrong})


def test_a_folder_with_a_study_of_other_sizes_is_refused_and_more_robots_are_not(tmp_path: Path) -> None:
    Experiment(chosen("hour", tasks="balance"), tmp_path, Laboratory(1))
    Experiment(chosen("hour", robots="1,2,3"), tmp_path, Laboratory(1))
    with pytest.raises(BringupError, match="other sizes"):
        Experiment(chosen("full"), tmp_path, Laboratory(1))


def test_fixed_randomisation_is_the_prior_with_all_its_draws_whatever_the_budget_of_the_others(tmp_path: Path) -> None:
    experiment = Experiment(TINY, tmp_path, Laboratory(1), threads=1)
    experiment.do(("collect", "balance", 11))
    found = experiment.do(("infer", "balance", 11, "fixed_dr"))
    assert len(experiment.store.load(found["model"]).particles) == PriorSettings().particles == 1000
    assert found["simulations"] == 0 and all(g["wall_s"] >= 0 for g in found["generations"])
    others = {c.method for c in CONTESTANTS.values()} - {"prior"}
    assert all(TINY.tasks["balance"].budget(name) == {"particles": 10, "generations": 1} for name in others)


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
        assert 0.005 < width < 0.021 if row["generation"] == 2 else width < 1e-9


def test_the_reduction_of_variance_has_an_interval_over_robots_and_none_with_two(tmp_path: Path) -> None:
    many, few = inferred(tmp_path / "many", 4), inferred(tmp_path / "few", 2)
    row = next(r for r in tables.variance_reduction(many, "balance") if r["name"] == WINNER)
    assert row["variance_reduction"] == pytest.approx(0.55) and row["truth_in_90"] == 3 and row["robots"] == 4
    assert 0.4 <= row["variance_reduction_low95"] < 0.5 < 0.6 < row["variance_reduction_high95"] <= 0.7
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
        page = write(findings, tmp_path / f"{robots}.html").read_text()
        assert "(mean − truth) / truth of mass" in page and "nan" not in page
        assert "What it took" in page and f"{3 * robots} of" in page


def test_intervals_cover_as_often_as_they_say() -> None:
    rng = np.random.default_rng(1)
    robots = [rng.normal(0, 1, 12) for _ in range(60)]  # one number of each of twelve robots, sixty times
    ends = np.array([tables.interval([np.array([x]) for x in each]) for each in robots])
    assert 0.8 <= np.mean((ends[:, 0] < 0) & (ends[:, 1] > 0)) <= 0.99
    assert tables.interval([np.array([1.0, 3.0])] * 2) == (1.0, 3.0)  # within two robots


def test_holms_correction_is_the_textbooks() -> None:
    rows = [{"p": p} for p in (0.01, 0.04, 0.03)]
    tables._holm(rows, "p")
    assert [r["p_holm"] for r in rows] == pytest.approx([0.03, 0.06, 0.06])


@pytest.mark.slow
def test_the_whole_experiment_runs_once_and_ends_in_tables_and_figures(tmp_path: Path) -> None:
    with Laboratory(1) as laboratory:
        experiment = Experiment(TINY, tmp_path, laboratory, threads=1)
        for piece in TINY.pieces():
            experiment.do(piece)
        findings = tables.Findings(TINY, Notebook(tmp_path / "study.jsonl"))
    trained = findings.notebook.get("train", "balance", 11, WINNER)
    assert (tmp_path / trained["policy"]).with_suffix(".json").is_file(), "relative, so that the folder can be moved"
    assert trained["unchanged"] == any("no moment of the training" in line for line in findings.left_out())
    assert findings.hidden(11) != "not looked at yet"
    found = tables.everything(findings)["tasks"]["balance"]
    assert [row["name"] for row in found["performance"]] == [FIRST, "fixed_dr", WINNER]
    assert all(row["rollouts"] == 2 and np.isfinite(row["return"]) for row in found["performance"])
    assert [row["sigma"] for row in found["noise"]] == [0.05, 0.05]
    fixed = [row for row in found["variance_reduction"] if row["name"] == "fixed_dr"]
    assert all(abs(row["variance_reduction"]) < 0.3 for row in fixed)
    page = write(findings, tmp_path / "study.html").read_text()
    assert all(f"Figure{what}" in page for what in ("s 6 to 8", " 9", " 11", " 12")) and "Table 6" in page
