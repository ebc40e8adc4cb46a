"""bench/calibration: what it counts is right, and a stopped run goes on where it was."""

import argparse
import dataclasses
import json
from collections.abc import Iterator
from types import ModuleType

import numpy as np
import pytest
from scipy.stats import kstest

from tcbi_sim.ray_workers import versions
from tcbi_sim.rigs import load_rig
from tests.bench_modules import BENCH, bench_modules

NAMES = ("figures", "jobs", "truths", "main")
CODE = versions()["tcbi"]  # which reads every file


@pytest.fixture(scope="module")
def bench() -> Iterator[dict[str, ModuleType]]:
    """The benchmark's modules, as its script sees them."""
    with bench_modules(BENCH / "calibration", NAMES) as modules:
        yield modules


def case(bench: dict[str, ModuleType], truth: int = 0, method: str = "calibrated"):
    return bench["jobs"].Case("model", "forward", truth, method, 0.0, 20, 8.0, 50, 6, 20, (("alpha", 5.0),))


def result(bench: dict[str, ModuleType], truth: int, method: str, error: float, sd: float = 0.05) -> dict:
    """An inference that is `error` off, with intervals of 1.645 sd on either side, of a parameter from 0 to 1."""
    at = 0.2 + 0.006 * truth
    parameter = {
        "name": "friction", "truth": at, "mean": at + error, "center": at + error, "low90": at + error - 1.645 * sd,
        "high90": at + error + 1.645 * sd, "identified": True, "unit_truth": at, "unit_error": error, "unit_sd": sd,
        "rank": 0.5,
    }  # fmt: skip
    return {"case": json.loads(case(bench, truth, method).key()), "parameters": [parameter], "cpu_s": 1.0} | {
        "code": CODE,
        "ess": 1e9,
        "simulations": 6000,
        "says_misfit": False,
        "says_outside": False,
    }


def value(rows: list[dict], words: str) -> dict:
    (row,) = [row for row in rows if words in row["name"]]
    return row


def test_errors_coverage_and_the_ratio_to_another_method(bench) -> None:
    rng = np.random.default_rng(0)
    errors = 0.05 * rng.standard_normal(100)
    found = [result(bench, i, "calibrated", e) for i, e in enumerate(errors)]
    found += [result(bench, i, "simopt", 2 * e) for i, e in enumerate(errors)]
    rows = bench["figures"].figures(found)
    rmse = value(rows, "calibrated: RMSE of friction, 100 truths")
    assert rmse["value"] == pytest.approx(np.sqrt(np.mean(errors**2)), abs=1e-3) and rmse["met"]
    covered = value(rows, "calibrated: 90 % intervals that hold the truth, of 100")
    assert covered["value"] == pytest.approx(np.mean(np.abs(errors) < 1.645 * 0.05), abs=1e-3)
    assert covered["target"] == "0.85 to 0.95"
    against = value(rows, "simopt: calibrated's error over its, 100 truths, 90 % 0.50 to 0.50")
    assert against["value"] == 0.5 and against["met"]
    narrow = bench["figures"].figures([result(bench, i, "calibrated", e, 0.01) for i, e in enumerate(errors)])
    assert not value(narrow, "calibrated: 90 % intervals that hold the truth, of 100")["met"]


def changed(found: list[dict], **values) -> list[dict]:
    return [{**one, "case": {**one["case"], **values}, "simulations": 6000} for one in found]


def targets(bench: dict[str, ModuleType], found: list[dict]) -> set:
    rows = bench["figures"].figures(found)
    return {row["target"] for row in rows if "RMSE" in row["name"] or "hold the truth, of 3" in row["name"]} - {None}


def test_targets_are_those_of_the_cases_that_they_were_set_for(bench) -> None:
    found = [result(bench, i, "calibrated", 0.01) for i in range(3)]
    both = {0.06, "0.85 to 0.95"}
    assert targets(bench, found) == both
    assert targets(bench, changed(found, source="robot")) == {0.06, 0.85}, "its truths are not the prior's"
    for other in ({"noise": 0.02}, {"rollouts": 6}, {"task": "balance"}):
        assert targets(bench, changed(found, **other)) == {"0.85 to 0.95"}, other
    assert targets(bench, changed(found, source="hidden")) == set()
    assert targets(bench, changed(found, method="paper")) == set()


def test_methods_of_several_budgets_are_compared_with_the_rollouts_that_each_took(bench) -> None:
    own = [result(bench, i, "calibrated", 0.01) for i in range(3)]
    found = changed(own, generations=3) + changed([result(bench, i, "paper", 0.02) for i in range(3)], settings=[])
    found[-1]["simulations"] = 9000
    words = "calibrated's error over its, alpha=5, 50 x 3: 6000 simulated rollouts to 7000"
    row = value(bench["figures"].figures(found), words)
    assert row["value"] == 0.5 and row["target"] == 1.0
    for one in found[:3]:
        one["simulations"] = 7400
    row = value(bench["figures"].figures(found), words.replace("6000", "7400"))
    assert row["value"] == 0.5 and row["target"] is None, "no equal budgets"
    apart = bench["figures"].figures(changed(own, task="balance") + found[3:])
    assert not any("error over its" in row["name"] for row in apart)


def test_a_hidden_effect_must_be_said_and_a_search_too_short_to_tell_is_counted_apart(bench) -> None:
    found = changed([result(bench, i, "calibrated", 0.01) for i in range(10)], source="hidden")
    for i, one in enumerate(found):
        one |= {"says_misfit": i < 8, "says_outside": i == 8, "says_untold": i == 9}

    def said(found: list[dict]) -> dict:
        return value(bench["figures"].figures(found), "calibrated: inferences that call the model wrong, of 10")

    assert (said(found)["value"], said(found)["target"], said(found)["met"]) == (0.9, 0.9, True)
    found[0]["says_misfit"] = False
    assert said(found)["met"] is False
    assert value(bench["figures"].figures(found), "inferences that cannot tell whether the model is")["value"] == 0.1
    assert said(changed(found, source="model"))["target"] is None
    del found[0]["says_untold"]
    assert not any("cannot tell" in row["name"] for row in bench["figures"].figures(found))


def test_the_budget_has_its_target_beside_the_papers(bench) -> None:
    paper = changed([result(bench, 0, "paper", 0.02)], generations=15, settings=[])
    for generations, met in ((3, True), (6, False)):
        own = changed([result(bench, 0, "calibrated", 0.01)], generations=generations, settings=[])
        own[0]["simulations"] = 1000 * generations
        row = value(bench["figures"].figures(own + paper), "calibrated: simulated rollouts over the paper's 15,000")
        assert (row["value"], row["target"], row["met"]) == (round(generations / 15, 3), 0.2, met)
        alone = bench["figures"].figures(own + changed(paper, generations=6))
        assert not any("15,000" in row["name"] for row in alone)


def options(**given) -> argparse.Namespace:
    rest = {"source": "model", "task": "forward", "truths": "0:1", "noise": "0", "set": [], "rollouts": 20, "bins": 20}
    return argparse.Namespace(**rest | {"duration": 8.0, "particles": 50, "generations": 6, "loop": "auto"} | given)


def test_a_method_may_have_a_budget_of_its_own_and_runs_without_a_setting_that_it_lacks(bench, capsys) -> None:
    made = bench["main"].cases(options(methods="paper@50x15,calibrated,simopt", set=["alpha=0.25"]))
    assert [(c.method, c.particles, c.generations, c.settings) for c in made] == [
        ("paper", 50, 15, (("alpha", 0.25),)), ("calibrated", 50, 6, (("alpha", 0.25),)), ("simopt", 50, 6, ()),
    ]  # fmt: skip
    assert "simopt has no setting alpha" in capsys.readouterr().err
    with pytest.raises(SystemExit, match="paper@50"):
        bench["main"].cases(options(methods="paper@50"))
    with pytest.raises(SystemExit, match="alhpa"):
        bench["main"].cases(options(methods="paper", set=["alhpa=1"]))


def test_an_inference_draws_from_no_stream_that_drew_its_truth(bench, monkeypatch) -> None:
    seeds, jobs = [], bench["jobs"]
    monkeypatch.setattr(jobs, "recorded", lambda *_: (None, []))
    monkeypatch.setattr(jobs.Problem, "of", lambda *_, seed, **__: seeds.append(seed))
    monkeypatch.setattr(jobs, "infer", lambda *_, seed, **__: seeds.append(seed) or 1 / 0)
    with pytest.raises(ZeroDivisionError):
        jobs.run(case(bench, 7))
    assert len(seeds) == 2 and min(seeds) >= 10**6


def test_ranks_are_judged_for_each_parameter_with_holms_correction(bench) -> None:
    rng = np.random.default_rng(0)
    found = [result(bench, i, "calibrated", 0.0) for i in range(60)]
    for one in found:
        (friction,) = one["parameters"]
        friction["rank"] = rng.random()
        one["parameters"] += [{**friction, "name": "mass"}, {**friction, "name": "gain", "rank": 0.3 * rng.random()}]
    rows = bench["figures"].figures(found)
    alone = kstest([one["parameters"][0]["rank"] for one in found], "uniform").pvalue
    assert value(rows, "uniform ranks of friction, by Holm for 3")["value"] == round(min(1.0, 2 * alone), 3)
    assert value(rows, "uniform ranks of gain")["value"] == 0.0


def test_exact_draws_have_uniform_ranks_however_few_they_are(bench) -> None:
    """Ten draws each of what 2000 truths are drawn from; a right test is below 0.001 once in a thousand times."""
    rng = np.random.default_rng(0)
    truths, draws = rng.standard_normal(2000), rng.standard_normal((2000, 10))
    found = [{**result(bench, i, "calibrated", 0.0), "ess": 10.0} for i in range(2000)]
    for one, share in zip(found, (draws < truths[:, None]).mean(axis=1), strict=True):
        one["parameters"][0]["rank"] = float(share)
    assert kstest([bench["figures"].rank(one, 0) for one in found], "uniform").pvalue > 0.001
    assert kstest([one["parameters"][0]["rank"] for one in found], "uniform").pvalue < 0.001, (
        "as they stand they are not"
    )


def test_holms_correction_is_the_textbooks(bench) -> None:
    assert bench["figures"].holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert bench["figures"].holm([0.9, 0.8]) == [1.0, 1.0]


def test_the_error_with_noise_is_compared_with_that_without(bench) -> None:
    found = [result(bench, i, "calibrated", 0.1) for i in range(10)]
    assert not any("without noise" in row["name"] for row in bench["figures"].figures(found))
    for noise, error in ((0.02, 0.12), (0.08, 0.15)):
        noisy = [result(bench, i, "calibrated", error) for i in range(10)]
        for one in noisy:
            one["case"]["noise"] = noise
        found += noisy
    rows = bench["figures"].figures(found)
    little, much = (value(rows, f"noise {n}, alpha=5: calibrated: error over that without noise") for n in (0.02, 0.08))
    assert (little["value"], little["target"], little["met"]) == (1.2, 1.25, True)
    assert (much["value"], much["met"]) == (1.5, False)


def test_a_stopped_run_goes_on_and_a_line_that_was_cut_off_is_run_again(bench, tmp_path, monkeypatch, capsys) -> None:
    keep, ran, main = tmp_path / "kept.jsonl", [], bench["main"]

    def run(wanted):
        ran.append(wanted.truth)
        return result(bench, wanted.truth, wanted.method, 0.0)

    monkeypatch.setattr(main, "run", run)
    cases = [case(bench, i) for i in range(4)]
    list(main.results(cases[:2], keep, 1))
    with keep.open("a") as file:
        file.write('{"case": {"sour')
    list(main.results(cases[:3], keep, 1))
    assert ran == [0, 1, 2]
    assert "cut off" in capsys.readouterr().err
    assert len(list(main.results(cases, keep, 1))) == 4 and ran == [0, 1, 2, 3]


def test_what_other_code_found_is_run_again_and_told(bench, tmp_path, monkeypatch, capsys) -> None:
    keep, main = tmp_path / "kept.jsonl", bench["main"]
    keep.write_text(json.dumps(result(bench, 0, "calibrated", 0.0) | {"code": "another"}) + "\n")
    monkeypatch.setattr(main, "run", lambda wanted: result(bench, wanted.truth, wanted.method, 0.5))
    (found,) = main.results([case(bench, 0)], keep, 1)
    assert found["parameters"][0]["unit_error"] == 0.5
    assert "1 results of other code are left out" in capsys.readouterr().err


def test_an_inference_that_fails_is_kept_and_counted_and_the_others_go_on(bench) -> None:
    wrong = dataclasses.replace(case(bench), rollouts=2, duration=1.0, settings=(("alpha", -1.0),))
    failed = bench["jobs"].run(wrong)
    assert "alpha" in failed["failed"]
    rows = bench["figures"].figures([failed, *(result(bench, i, "calibrated", 0.01) for i in range(3))])
    assert value(rows, "inferences that failed")["value"] == 1
    assert value(rows, "RMSE of friction, 3 truths")["value"] == 0.01


def test_with_the_papers_budget_the_papers_accuracy_is_asked_for(bench) -> None:
    found = changed([result(bench, i, "calibrated", 0.02) for i in range(3)], generations=3)
    found += changed([result(bench, i, "paper", 0.01) for i in range(3)], generations=15)
    row = value(bench["figures"].figures(found), "paper: calibrated's error over its")
    assert (row["value"], row["target"], row["met"]) == (2.0, 1.0, False)


@pytest.mark.slow
@pytest.mark.parametrize(("source", "loop"), [("model", ""), ("robot", ""), ("robot", "acting")])
def test_an_inference_of_a_known_truth_is_judged(bench, source: str, loop: str) -> None:
    small = bench["jobs"].Case(source, "forward", 0, "rejection", 0.02, 4, 1.0, 10, 1, 20, (), loop)
    found = json.loads(json.dumps(bench["jobs"].run(small)))
    assert [p["name"] for p in found["parameters"]] == ["friction", "mass", "gain"]
    assert found["closed_loop"] == (loop == "acting") and found["simulations"] == 40
    assert all(p["low90"] <= p["high90"] and 0 <= p["rank"] <= 1 for p in found["parameters"])


def test_a_models_readings_have_the_rigs_noise_positions_and_encoder_steps_too(bench) -> None:
    noise = load_rig("hexapod").noise
    _, (m, _) = bench["truths"].recorded("model", "balance", 0, 2, 1.0)
    clean = dataclasses.replace(m, position=np.zeros((4000, 3)))
    noisy = bench["truths"].with_noise(clean, noise, np.random.default_rng(0))
    assert noisy.position.std() == pytest.approx(noise.position, rel=0.05)
    steps = m.joint_position / noise.encoder_step
    assert np.allclose(steps, np.round(steps), atol=1e-9)


def test_noise_of_equation_14_has_the_size_asked_for(bench) -> None:
    _, rollouts = bench["truths"].recorded("model", "balance", 0, 2, 1.0)
    noisy = bench["truths"].with_state_noise(rollouts, 0.05, 0)
    pairs = zip(noisy, rollouts, strict=True)
    added = np.concatenate([(a.joint_position - b.joint_position).ravel() for a, b in pairs])
    assert added.std() == pytest.approx(0.05, rel=0.05)
    assert bench["truths"].with_state_noise(rollouts, 0.0, 0) is rollouts


def test_noise_of_equation_14_is_in_what_the_policy_sees_too(bench) -> None:
    (_, (quiet, gait)), (_, (shaken, same)) = (
        bench["truths"].recorded("robot", "balance", 0, 2, 1.0, sigma) for sigma in (0.0, 0.08)
    )
    assert np.abs(shaken.commands.target - quiet.commands.target).max() > 0.01, "the policy's"
    np.testing.assert_array_equal(gait.commands.target, same.commands.target)
