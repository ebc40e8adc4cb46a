"""bench/training: a kept result is taken for its own configuration alone."""

import dataclasses
import importlib.util
from pathlib import Path
from types import ModuleType

import pytest


@pytest.fixture(scope="module")
def bench() -> ModuleType:
    path = Path(__file__).resolve().parents[1] / "bench" / "training.py"
    spec = importlib.util.spec_from_file_location("training_bench", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_quick_and_full_results_in_one_file_are_told_apart(bench: ModuleType, tmp_path: Path, monkeypatch) -> None:
    ran = []

    def trained(config):
        ran.append((config.seed, config.steps))
        return bench.facts(config) | {"curve": [{"steps": config.steps}]}

    monkeypatch.setattr(bench, "trained", trained)
    keep = tmp_path / "kept.jsonl"
    quick = bench.results("balance", range(1), 100, keep)
    full = bench.results("balance", range(2), 0, keep)
    steps = bench.preset("fast", "balance").steps
    assert ran == [(0, 100), (0, steps), (1, steps)]
    assert (
        bench.results("balance", range(1), 100, keep) == quick and bench.results("balance", range(2), 0, keep) == full
    )
    assert len(ran) == 3, "nothing is run twice"
    other = dataclasses.replace(bench.preset("fast", "balance"), learning_rate=1e-4)
    monkeypatch.setattr(bench, "preset", lambda *_: other)
    bench.results("balance", range(1), 0, keep)
    assert len(ran) == 4, "of another configuration with the same seed and steps"
    monkeypatch.setattr(bench, "LOADED", "code of another day")
    bench.results("balance", range(1), 0, keep)
    assert len(ran) == 5, "of other physics"
