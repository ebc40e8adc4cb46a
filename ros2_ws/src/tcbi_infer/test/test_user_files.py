"""A user's own statistics and divergences: found in a folder, used by name, and never able to break the rest."""

import logging
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from tcbi_cases import BENCH_TRUTH, bench_rollouts

from tcbi_infer import divergence, statistics
from tcbi_infer.errors import InferError
from tcbi_infer.tcbi.problem import Problem

SPEED = '''
"""Speed of every joint."""
import numpy as np
from tcbi_infer.statistics import Statistic

def speed(arrays):
    return np.swapaxes(np.gradient(arrays.joint_position, arrays.time, axis=2), -1, -2)

STATISTIC = Statistic("speed", "rad/s", "speed of each joint", (), lambda arrays: arrays.joint_names, speed)
'''
MEANS = """
import numpy as np

def DIVERGENCE(real, simulated):
    return np.abs(np.nanmean(simulated, axis=1) - np.nanmean(real))
"""


@pytest.fixture
def folders(tmp_path: Path, monkeypatch) -> Iterator[Path]:
    for kind in ("statistics", "divergences"):
        (tmp_path / kind).mkdir()
        monkeypatch.setenv(f"TCBI_{kind.upper()}", str(tmp_path / kind))
    clear()
    yield tmp_path
    clear()


def clear() -> None:
    statistics.library.cache_clear()
    divergence.library.cache_clear()


def test_a_statistic_and_a_divergence_in_a_file_are_used_by_name(folders: Path) -> None:
    (folders / "statistics" / "speed.py").write_text(SPEED)
    (folders / "divergences" / "means.py").write_text(MEANS)
    model, measurements = bench_rollouts(count=4)
    problem = Problem.of(model, measurements, statistics=("speed",), divergence_name="means", timestep=0.01)
    unit = np.array([BENCH_TRUTH, (0.9, *BENCH_TRUTH[1:])])
    assert problem.observed.statistics == ("speed",)
    assert problem.simulate(unit).divergence.shape == (2, 1)
    assert {"js", "mmd", "means"} <= set(divergence.library())


@pytest.mark.parametrize(
    ("kind", "name", "text", "said"),
    [
        ("statistics", "broken", "def (", "line 1"),
        ("statistics", "empty", "x = 1", "defines no STATISTIC"),
        ("statistics", "wrong", "STATISTIC = 3", "must be a Statistic"),
        ("statistics", "reward", SPEED, "the name 'reward' is taken already"),
        ("statistics", "fast", SPEED, "call the file speed.py"),
        ("divergences", "flat", "def DIVERGENCE(r, s): return 0 * s[:, 0]", "must be finite and grow"),
        ("divergences", "shape", "def DIVERGENCE(r, s): return 1.0", "gave shape ()"),
        ("divergences", "fails", "def DIVERGENCE(r, s): return 1 / 0", "line 1: ZeroDivisionError"),
    ],
)
def test_a_file_that_cannot_be_used_is_left_out_with_a_line(folders, caplog, kind, name, text, said) -> None:
    (folders / kind / f"{name}.py").write_text(text)
    with caplog.at_level(logging.WARNING):
        known = statistics.library() if kind == "statistics" else divergence.library()
    assert len(known) == (8 if kind == "statistics" else 4)
    assert len(caplog.records) == 1 and said in caplog.records[0].getMessage()


def test_a_folder_that_is_not_there_is_said_where_it_was_asked_for(folders: Path, caplog, monkeypatch) -> None:
    monkeypatch.setenv("TCBI_STATISTICS", str(folders / "gone"))
    with caplog.at_level(logging.WARNING):
        assert len(statistics.library()) == 8
    assert "is no folder; make it, or unset TCBI_STATISTICS" in caplog.text


def test_the_examples_of_the_page_are_fit_for_use(folders: Path) -> None:
    page = Path(__file__).resolve().parents[4] / "docs" / "tcbi.md"
    shown = re.findall(r"```python\n(\"\"\"(\w+/\w+\.py):.*?)```", page.read_text(), re.DOTALL)
    assert [name for _, name in shown] == ["statistics/joint_speed.py", "divergences/means.py"]
    for text, name in shown:
        (folders / name).write_text(text)
    problem = Problem.of(*bench_rollouts(count=3), statistics=("joint_speed",), divergence_name="means", timestep=0.01)
    assert np.isfinite(problem.simulate(np.array([BENCH_TRUTH])).divergence).all()
    constant = np.full(60, 0.1)
    assert np.isfinite(divergence.measured("means", constant, np.stack([constant, constant + 1]))).all()


def test_a_users_statistic_that_fails_on_rollouts_is_named_with_its_line(folders: Path) -> None:
    (folders / "statistics" / "speed.py").write_text(SPEED.replace("axis=2", "axis=9"))
    with pytest.raises(InferError, match=r"statistic speed fails: line 7: .*axis 9"):
        Problem.of(*bench_rollouts(count=3), statistics=("speed",))


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (("(), lambda", '("velocity",), lambda'), "AttributeError: .*velocity"),
        (("joint_names, speed)", "joint_names, speed, lambda a: a.gone)"), "line 9: AttributeError: .*gone"),
        (("arrays.joint_names", "arrays.legs"), "line 9: AttributeError: .*legs"),
        (("arrays.joint_names", "None"), "TypeError: 'NoneType'"),
        (("    return np", "    return np.full((1, 3, 1, 9), 'fast')\n    np"), "ValueError: could not convert string"),
    ],
)
def test_whatever_of_a_users_statistic_fails_it_is_named(folders: Path, wrong: tuple[str, str], said: str) -> None:
    (folders / "statistics" / "speed.py").write_text(SPEED.replace(*wrong))
    with pytest.raises(InferError, match=f"statistic speed fails: {said}"):
        Problem.of(*bench_rollouts(count=3), statistics=("speed",))


def own_divergence(folders: Path, line: str) -> Problem:
    """A problem with a divergence of the user's that passes its check and meets `line` when it is used."""
    text = MEANS.replace("    return", f"    if len(simulated) != 2 or len(real) != 60: {line}\n    return")
    (folders / "divergences" / "means.py").write_text(text)
    return Problem.of(*bench_rollouts(count=3), statistics=("joint_tracking",), divergence_name="means", timestep=0.01)


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("return 1 / 0", "divergence means fails: line 5: ZeroDivisionError"),
        ("return 'far'", "divergence means fails: ValueError"),
        ("return np.ones((2, 2))", r"divergence means gave shape \(2, 2\), must be \(3,\)"),
    ],
)
def test_a_users_divergence_that_fails_on_rollouts_is_named(folders: Path, line: str, said: str) -> None:
    problem = own_divergence(folders, line)
    with pytest.raises(InferError, match=said):
        problem.simulate(np.full((3, 3), 0.5))


def test_a_divergence_that_is_not_known_is_never_better_than_any(folders: Path) -> None:
    problem = own_divergence(folders, "return np.where(np.arange(len(simulated)) == 1, np.nan, 0.5)")
    assert problem.simulate(np.full((3, 3), 0.5)).divergence[:, 0].tolist() == [0.5, np.inf, 0.5]
