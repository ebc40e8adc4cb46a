"""bench/inference_peers.py: when a peer's error is as small as TCBI's, and stays so."""

import dataclasses
import json
import sys
from collections.abc import Iterator
from types import ModuleType

import numpy as np
import pytest

from tcbi_infer.tcbi.driver import infer
from tcbi_infer.tcbi.problem import Problem
from tcbi_sim.engine import simulate
from tcbi_sim.measurement import Commands, Scenario
from tcbi_sim.model import base_model
from tests.bench_modules import BENCH, bench_modules


@pytest.fixture(scope="module")
def bench() -> Iterator[ModuleType]:
    with bench_modules(BENCH, ("inference_peers",)) as modules:
        yield modules["inference_peers"]


def beliefs(*pairs: tuple[float, float]) -> list[dict]:
    return [{"wall_s": t, "simulations": 50, "error": [e, -e], "sd": [0.1, 0.1]} for t, e in pairs]


def truth(number: int, **found: list[dict]) -> dict:
    return {"truth": number, "parameters": ["a", "b"], "beliefs": found}


def test_a_peer_has_arrived_when_its_error_stays_small(bench):
    found = [truth(0, tcbi=beliefs((2.0, 0.1)), pyabc=beliefs((4.0, 0.05), (8.0, 0.3), (12.0, 0.1), (16.0, 0.02)))]
    assert bench.as_long(found, "pyabc") == (6.0, 6.0, 6.0)


def test_the_error_is_that_of_all_truths_together(bench):
    slow = truth(0, tcbi=beliefs((1.0, 0.1)), sbi=beliefs((3.0, 0.5), (7.0, 0.1)))
    fast = truth(1, tcbi=beliefs((2.0, 0.1)), sbi=beliefs((2.0, 0.1)))
    middle, low, high = bench.as_long([slow, fast], "sbi")
    assert middle == 7.0
    assert low == 1.0 and high == 7.0, "of resampled truths some hold the fast one alone"


def test_a_peer_that_never_arrives_has_no_time(bench, capsys):
    found = [truth(0, tcbi=beliefs((1.0, 0.1)), pyabc=beliefs((2.0, 0.3)), sbi=[])]
    assert np.isinf(bench.as_long(found, "pyabc")[0])
    rows = {row["name"]: row["value"] for row in bench.figures(found, ["pyabc", "sbi"])}
    assert rows["pyabc: time to TCBI's error, to TCBI's time"] is None
    assert not any(name.startswith("sbi") for name in rows)
    said = capsys.readouterr().err
    assert "pyabc: its error was never as small" in said and "sbi: no round was finished on 1 of 1" in said


def test_a_line_that_was_cut_off_is_run_again(bench, tmp_path, capsys):
    file = tmp_path / "kept.jsonl"
    file.write_text(json.dumps(truth(3)) + '\n{"truth": 4, "par')
    assert [r["truth"] for r in bench.kept(file)] == [3]
    assert "left out" in capsys.readouterr().err


def test_a_kept_result_is_taken_for_its_own_case_alone(bench, tmp_path, monkeypatch, capsys):
    ran = []

    def inferred(case):
        ran.append(case)
        return {"case": json.loads(case.key()), "beliefs": {}}

    monkeypatch.setattr(bench, "run", inferred)
    keep = tmp_path / "kept.jsonl"
    keep.write_text(json.dumps(truth(0)) + '\n{"case": {"tr')  # of before cases were kept, and cut off
    case = bench.Case("forward", 0, 6, 1.6, 6, ("sbi",))
    bench.results([case], keep)
    others = [
        dataclasses.replace(case, **changed)
        for changed in ({"task": "balance"}, {"rollouts": 2}, {"duration": 1.0}, {"generations": 2}, {"peers": ()})
    ]
    found = bench.results([case, *others], keep)
    assert ran == [case, *others] and [r["case"] for r in found] == [json.loads(c.key()) for c in ran]
    assert bench.results(others[:1], keep) == found[1:2] and len(ran) == 6, "nothing is run twice"


def test_tcbis_mean_is_taken_on_the_scale_of_its_peers(bench, monkeypatch):
    peers, problem = sys.modules["peers.inference"], servo_problem()
    found = []

    def kept(*args, **settings):
        found.append(infer(*args, **settings))
        return found[0]

    monkeypatch.setattr(peers, "infer", kept)
    monkeypatch.setattr(peers, "POPULATION", 10)
    last = peers.with_tcbi(problem, 0, 1)[-1]
    weights = np.exp(found[0].log_weights)
    mean = weights @ found[0].unit
    assert last.mean == pytest.approx(mean)
    assert last.sd == pytest.approx(np.sqrt(weights @ (found[0].unit - mean) ** 2))
    assert not np.allclose(problem.model.to_unit(weights @ found[0].particles), mean, atol=0.01)


def servo_problem() -> Problem:
    """Random steps of a servo bench, whose parameters have logarithmic scales."""
    model, rng = base_model("servo_bench"), np.random.default_rng(0)
    times = np.arange(0.0, 1.0, 0.25)
    commands = [Commands(times, rng.uniform(-1, 1, (len(times), 1))) for _ in range(3)]
    scenarios = [Scenario("steps", 1.0, seed=i) for i in range(3)]
    rollouts = simulate(model, model.mean(), scenarios, commands=commands)
    measured = [rollouts.measurement(0, i, f"steps-{i}") for i in range(3)]
    measured = [dataclasses.replace(m, commands=c) for m, c in zip(measured, commands, strict=True)]
    return Problem.of(model, measured, timestep=0.01)
