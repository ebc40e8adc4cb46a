"""Benchmarks of inference and of its scale: what they measure runs, on a tiny problem and without Ray."""

from collections.abc import Iterator
from types import ModuleType

import pytest

from tcbi_sim.model import base_model
from tests.bench_modules import BENCH, bench_modules

NAMES = ("engine", "scale_model", "scale", "inference", "iteration")


@pytest.fixture(scope="module")
def bench() -> Iterator[dict[str, ModuleType]]:
    """The benchmarks' modules, as their scripts see them."""
    with bench_modules(BENCH, NAMES) as modules:
        yield modules


def test_the_costs_of_a_step_and_of_a_chunk_are_measured(bench) -> None:
    found = bench["scale"].of_steps(bench["scale"].problem(base_model("hexapod"), 2, 0.4))
    assert set(found) == {"step_s", "chunk_s"} and found["chunk_s"] > 0


def test_what_travels_is_measured(bench, monkeypatch) -> None:
    monkeypatch.setattr(bench["scale"], "RECORDED", 2)
    monkeypatch.setattr(bench["scale"], "LONG_S", 0.4)
    found = bench["scale"].what_travels(base_model("hexapod"))
    assert len(found) == 5 and all(size > 0 for size in found.values())


@pytest.mark.parametrize("loop", ["open loop", "closed loop"])
def test_a_generation_is_weighed_in_either_loop(bench, monkeypatch, loop: str) -> None:
    inference = bench["inference"]
    monkeypatch.setattr(inference, "ROLLOUTS", 2)
    monkeypatch.setattr(inference, "DURATION_S", 0.4)
    monkeypatch.setattr(inference, "PARTICLES", 10)
    monkeypatch.setattr(inference, "BEFORE", 1)
    made, problem = [], inference.problem
    monkeypatch.setattr(inference, "problem", lambda *given: made.append(problem(*given)) or made[-1])
    ratio, rest = inference.beside_stepping(loop, 1)
    assert ratio["value"] > 0 and 0 < rest["value"] < 1
    assert made[0].closed_loop == (loop == "closed loop")


def test_what_is_timed_again_and_again_is_the_sixth_generation(bench) -> None:
    step = bench["inference"].generation(bench["scale"].problem(base_model("hexapod"), 2, 0.4), 10)
    for _ in range(2):
        state, _ = step()
        assert state.generation == 6 and len(state.z) == 60


def test_iterations_of_every_method_are_timed_with_and_without_their_simulations(bench, monkeypatch) -> None:
    monkeypatch.setattr(bench["iteration"], "PARTICLES", 10)
    found = {row["name"]: row["value"] for row in bench["iteration"].figures("balance", 2, 2.0, 2)}
    for label in bench["iteration"].METHODS.values():
        rest = found[f"balance: {label}, of it beside simulation, median"]
        assert found[f"balance: {label}, an iteration, median"] > rest > 0
