"""The study at work: what is done is kept, and what is cut off or fails is done again."""

import dataclasses
import functools
import json
import os
import pickle
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import numpy as np
import pytest

from tcbi_bringup.cli import find, parser_for
from tcbi_bringup.commands import study
from tcbi_bringup.demo import plan as demo
from tcbi_bringup.errors import BringupError, WrongCallError
from tcbi_bringup.study import experiment as pieces_of_work
from tcbi_bringup.study import tables
from tcbi_bringup.study.experiment import Experiment
from tcbi_bringup.study.notebook import Notebook, hold
from tcbi_bringup.study.page import write
from tcbi_bringup.study.plan import (
    CONTESTANTS,
    EFFECT,
    FIRST,
    PRESETS,
    WINNER,
    Plan,
    TaskPlan,
    chosen,
    cost,
    of_what_is_there,
)
from tcbi_bringup.study.robots import Laboratory
from tcbi_contract.errors import UsageError
from tcbi_infer.baselines.prior import PriorSettings
from tcbi_infer.errors import InferError
from tcbi_infer.tcbi.method import METHODS
from tcbi_policy import runs
from tcbi_policy.configuration import preset
from tcbi_sim.engine import SimError
from tcbi_sim.model import base_model

TINY = Plan(
    {"balance": TaskPlan("balance-early", 2, 10, 1, 1280, 2, 1)}, ((11, "strong"),), ("fixed_dr", WINNER), (0.05,)
)


def test_a_study_goes_on_where_it_was_and_does_nothing_twice(tmp_path: Path) -> None:
    notebook = Notebook(tmp_path / "study.jsonl")
    assert notebook.once(("train", "balance", 1), lambda: {"x": np.float64(1.5)})["x"] == 1.5
    with (tmp_path / "study.jsonl").open("a") as file:
        file.write('{"key": ["train", "bal')  # the power failed here, or another process is writing
    before = (tmp_path / "study.jsonl").read_bytes()
    again = Notebook(tmp_path / "study.jsonl")
    assert (tmp_path / "study.jsonl").read_bytes() == before, "to look at it changes nothing"
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
    assert not [stage for stage in ("infer", "train") if (stage, "balance", 11, "bayesopt") in kept]


@pytest.mark.parametrize("error", [SimError("diverged"), np.linalg.LinAlgError("singular"), BrokenProcessPool("died")])
@pytest.mark.parametrize("stage", ["collect", "diagnose", "infer", "train", "deploy", "noise"])
def test_a_piece_that_fails_is_left_out_with_its_reason_and_tried_again(stage, error, tmp_path, monkeypatch) -> None:
    def failing(*_: object) -> None:
        raise error

    plan = dataclasses.replace(TINY, contestants=(WINNER, EFFECT))
    results = {
        "collect": {"truth": {"hidden": "backlash", "effect": {}}},
        "diagnose": {"verdict": "", "effects": [], "statement": "nothing", "model": "v1"},
        "infer": {"model": "v1", "warnings": []},
        "train": {"policy": "p", "unchanged": False},
        "deploy": {},
        "noise": {},
    }
    work = Experiment(plan, tmp_path, Laboratory(1), threads=1)
    for name, result in results.items():
        monkeypatch.setattr(work, f"_{name}", functools.partial(lambda found, *_: dict(found), result))
    monkeypatch.setattr(work, f"_{stage}", failing)
    done = {piece: work.do(piece) for piece in plan.pieces()}
    assert all(("left_out" in result) == (piece[0] == stage) for piece, result in done.items())
    kept = Notebook(tmp_path / "study.jsonl")
    assert all((piece in kept) == (piece[0] != stage) for piece in done)
    line = next(line for line in tables.Findings(plan, kept).left_out() if "left out" in line)
    assert f"{stage} failed: {type(error).__name__}: {error}" in line and "robot 11" in line
    monkeypatch.setattr(work, f"_{stage}", lambda *_: results[stage])
    assert not [piece for piece in done if "left_out" in work.do(piece)]


def test_what_needs_a_piece_that_failed_is_left_out_with_the_same_reason(tmp_path, monkeypatch) -> None:
    def failing(*_: object, **__: object) -> None:
        raise SimError("diverged")

    plan = dataclasses.replace(TINY, contestants=(EFFECT, WINNER))
    work = Experiment(plan, tmp_path, Laboratory(1), threads=1)
    monkeypatch.setattr(work.laboratory, "run", failing)
    done = [work.do(piece) for piece in plan.pieces()]
    reasons = {result["left_out"] for result in done}
    assert reasons == {f"{stage} failed: SimError: diverged" for stage in ("diagnose", "collect", "deploy")}
    findings = tables.Findings(plan, work.notebook)
    assert "collect failed" in write(findings, tmp_path / "study.html").read_text()


def test_a_training_goes_on_with_the_same_configuration_model_and_code_alone(tmp_path, monkeypatch) -> None:
    work = Experiment(TINY, tmp_path, Laboratory(1), threads=1)
    model, config = base_model("hexapod"), preset("fast", "balance")

    def folder(robot: int = 1, **changes: int) -> Path:
        return work._run_folder(f"study-{robot}-tcbi", dataclasses.replace(config, **changes), model, "balance-early")

    first, other = folder(), folder(robot=11)
    assert first == folder() == folder(threads=2) != other
    second = folder(steps=160)
    assert second != first and second.is_dir() and not first.exists()
    monkeypatch.setattr(runs, "LOADED", "code changed")
    assert folder(steps=160) != second and not second.exists() and other.is_dir()


def studied(folder: Path, *words: str) -> int:
    return study.run(parser_for(find("study"), study).parse_args(["--out", str(folder), *words]))


def test_a_report_is_only_written_of_a_study_and_changes_nothing_of_it(tmp_path: Path, capsys) -> None:
    with pytest.raises(WrongCallError, match=r"holds no study.*--out"):
        studied(tmp_path / "typo", "--report")
    assert not (tmp_path / "typo").exists()
    Experiment(chosen("hour", tasks="balance"), tmp_path, Laboratory(1))
    (tmp_path / "study.jsonl").write_text('{"key": ["half')
    names = ("plan.json", "study.jsonl")
    before = [((tmp_path / name).read_bytes(), (tmp_path / name).stat().st_mtime_ns) for name in names]
    with hold(tmp_path):
        assert studied(tmp_path, "--report") == 0
    assert before == [((tmp_path / name).read_bytes(), (tmp_path / name).stat().st_mtime_ns) for name in names]
    assert (tmp_path / "study.html").is_file() and "0 of" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [("study.jsonl", '{"key": ["collect"], "result": {}}\n{"key\n', "line 2: .*remove that line"),
     ("plan.json", "{", "no plan of a study; remove it")],
)  # fmt: skip
def test_a_damaged_file_of_a_study_is_named_with_what_to_do(tmp_path: Path, name: str, text: str, said: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(BringupError, match=f"{name}.*{said}"):
        studied(tmp_path, "--tasks", "balance", "--robots", "11")


def test_a_second_process_on_a_study_is_refused_in_one_line_that_names_the_first(tmp_path: Path) -> None:
    with hold(tmp_path), pytest.raises(BringupError, match=f"process {os.getpid()} goes on") as refused:
        studied(tmp_path)
    assert "\n" not in str(refused.value)
    with hold(tmp_path):
        pass


def test_a_study_that_is_interrupted_leaves_a_report(tmp_path: Path, monkeypatch) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Experiment, "_collect", interrupted)
    with pytest.raises(KeyboardInterrupt):
        studied(tmp_path, "--robots", "11", "--tasks", "balance", "--methods", "fixed_dr", "--threads", "1")
    assert "0 of 6 pieces" in (tmp_path / "study.html").read_text()
    assert json.loads((tmp_path / "study.json").read_text())["robots"] == [11]


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
    assert chosen("hour", contestants="abc,tcbi_effect").contestants == ("abc", WINNER, EFFECT)
    assert chosen("hour", contestants="tcbi_effect,tcbi", robots="7,7").contestants == (EFFECT, WINNER)
    assert chosen("hour", robots="7,07").robots == ((7, "strong"),)
    for wrong in ({"preset": "day"}, {"robots": "a"}, {"tasks": "dance"}, {"contestants": "magic"}):
        with pytest.raises(UsageError, match=next(iter(wrong.values()))):
            chosen(**{"preset": "hour", **wrong})


def test_a_report_shows_what_was_worked_on_unless_something_is_named() -> None:
    keys = [
        ("diagnose", 13),
        ("collect", "balance", 11),
        ("infer", "balance", 13, "abc"),
        ("deploy", "balance", 11, FIRST),
    ]
    plan = of_what_is_there(PRESETS["hour"], keys)
    assert plan.robots == ((11, "strong"), (13, "strong"))
    assert list(plan.tasks) == ["balance"] and plan.contestants == ("abc",)
    named = of_what_is_there(chosen("hour", robots="12", tasks="forward"), keys, ("12", "forward", ""))
    assert named.robots == ((12, "strong"),) and list(named.tasks) == ["forward"]
    assert of_what_is_there(PRESETS["hour"], []) == PRESETS["hour"]
    asked = of_what_is_there(PRESETS["hour"], keys, asked=([11, 14], ["forward"], ["tcbi"]))
    assert [n for n, _ in asked.robots] == [11, 13, 14] and list(asked.tasks) == ["balance", "forward"]
    assert asked.contestants == ("abc", "tcbi")


def test_every_piece_has_a_share_of_the_estimate() -> None:
    assert all(cost(piece) > 0 for plan in PRESETS.values() for piece in plan.pieces())
    assert cost(("infer", "forward", 11, "fixed_dr")) < cost(("infer", "forward", 11, WINNER))


def test_the_page_on_the_study_has_the_presets_sizes() -> None:
    page = (Path(__file__).resolve().parents[4] / "docs" / "study.md").read_text()
    for name, plan in PRESETS.items():
        tasks = list(plan.tasks.values())

        def each(of: Callable[[TaskPlan], str], tasks: list[TaskPlan] = tasks) -> str:
            return ", ".join(dict.fromkeys(of(task) for task in tasks))

        cells = (
            f"`{name}`", str(len(plan.robots)), each(lambda t: str(t.rollouts)),
            each(lambda t: f"{t.particles} x {t.generations}"), each(lambda t: str(t.steps)),
            each(lambda t: str(t.deployments)), each(lambda t: str(t.noisy)),
        )  # fmt: skip
        assert f"| {' | '.join(cells)} |" in page


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


@pytest.mark.slow
def test_the_whole_experiment_runs_once_and_ends_in_tables_and_figures(tmp_path: Path, monkeypatch) -> None:
    usual = pieces_of_work.fine_tuning
    small = {"environments": 16, "evaluations": 4}
    monkeypatch.setattr(pieces_of_work, "fine_tuning", lambda config: dataclasses.replace(usual(config), **small))
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
    assert all(f"Figure{what}" in page for what in (" 6", " 7", " 8", " 9", " 11", " 12")) and "Table 6" in page


SMALL = Plan(
    {"balance": TaskPlan("balance-early", 2, 10, 1, 160, 2, 1)},
    ((11, "strong"), (12, "strong")),
    ("simopt", WINNER, EFFECT),
    (0.05,),
    dataclasses.replace(
        demo.QUICK,
        motions=("steps",),
        repeated=0,
        motion_s=1.0,
        effects=("viscous_damping",),
        settings=dataclasses.replace(demo.QUICK.settings, refine=1, timestep=0.01, coarse=0.01),
    ),
)
SHORTER = """
import dataclasses, functools, pickle, sys
from tcbi_bringup import cli
from tcbi_bringup.study import experiment, plan

diagnose, fine_tuning = experiment.diagnose, experiment.fine_tuning

def adopted(model, rollouts, **options):  # so little data proves nothing: the second robot's candidate is taken anyhow
    found = diagnose(model, rollouts, **options)
    named = dataclasses.replace(found, verdict=experiment.EFFECT_FOUND, uses=(found.ranking[0].use,))
    return named if rollouts[0].rollout_id.startswith("emulated-12-") else found

experiment.diagnose = adopted
experiment.fine_tuning = lambda config: dataclasses.replace(fine_tuning(config), environments=4, evaluations=2)
experiment.Request = functools.partial(experiment.Request, duration_s=2.0)
plan.PRESETS["small"] = pickle.load(sys.stdin.buffer)
sys.exit(cli.main(["study", "--preset", "small", "--out", sys.argv[1], "--threads", "2", "--json"]))
"""


def small_study(folder: Path) -> subprocess.Popen[bytes]:
    process = subprocess.Popen([sys.executable, "-c", SHORTER, str(folder)], stdin=-1, stdout=-1, stderr=-1)
    assert process.stdin is not None
    process.stdin.write(pickle.dumps(SMALL))
    process.stdin.close()
    process.stdin = None
    return process


def children(pid: int) -> set[int]:
    return {int(n) for n in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()}


def until(condition: Callable[[], object], seconds: float = 120.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.mark.slow
def test_a_study_with_many_methods_and_workers_that_is_killed_goes_on_to_its_end(tmp_path: Path) -> None:
    path, pieces = tmp_path / "study.jsonl", list(SMALL.pieces())
    first = small_study(tmp_path)
    until(lambda: first.poll() is not None or (path.exists() and path.read_text().count("\n") > len(pieces) // 3))
    workers = children(first.pid)
    first.kill()
    first.communicate()
    before = path.read_text()
    assert first.returncode < 0 and workers
    until(lambda: not any(Path(f"/proc/{worker}").exists() for worker in workers), 10.0)

    second = small_study(tmp_path)
    out, errors = second.communicate(timeout=240)
    assert second.returncode == 0, errors.decode()
    assert path.read_text().startswith(before[: before.rfind("\n") + 1]), "nothing is done twice"
    findings = tables.Findings(SMALL, Notebook(path))
    assert all(piece in findings.notebook for piece in pieces)
    assert not [piece for piece in pieces if "left_out" in findings.notebook.get(*piece)]
    assert findings.notebook.get("deploy", "balance", 11, EFFECT)["same_as"] == WINNER
    data = json.loads(out)
    assert data == {**json.loads((tmp_path / "study.json").read_text()), "report": str(tmp_path / "study.html")}
    found = data["tasks"]["balance"]
    rows = {row["name"]: row["robots"] for row in found["performance"]}
    assert rows == {FIRST: 2, **dict.fromkeys(SMALL.contestants, 2), EFFECT: 1}
    assert {row["name"]: row["robots"] for row in found["comparisons"]} == {
        k: n for k, n in rows.items() if k != WINNER
    }
    assert found["effect"]["robots"] == 1 and found["effect"]["right"] == 0, "a weak leg is hidden, not damping"
    assert "TCBI with the effect (1 of 2 robots)" in (tmp_path / "study.html").read_text()
