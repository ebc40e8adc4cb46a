"""`./tcbi test`: every check where nothing is named, pytest alone where something is."""

import subprocess
import types

import pytest

from tcbi_bringup import cli
from tcbi_bringup.commands import test as command


@pytest.fixture
def started(monkeypatch):
    """The modules that the command starts, with their arguments; each ends with status 0."""
    calls: list[list[str]] = []

    def run(words, **_):
        assert words[1] == "-m"
        calls.append(words[2:])
        return types.SimpleNamespace(returncode=0)

    monkeypatch.setattr(subprocess, "run", run)
    return calls


def test_without_arguments_linter_formatter_and_types_are_checked_and_the_tests_run_on_all_processors(started):
    assert cli.main(["test"]) == 0
    assert [call[0] for call in started] == ["ruff", "ruff", "mypy", "pytest"]
    assert started[-1][1 : len(command.PARALLEL) + 1] == list(command.PARALLEL)


@pytest.mark.parametrize("words", [["-k", "urdf"], ["--", "-k", "urdf"]])
def test_arguments_go_to_pytest_alone(started, words):
    assert cli.main(["test", *words]) == 0
    ((module, *arguments),) = started
    assert module == "pytest" and arguments[:2] == ["-k", "urdf"] and arguments[2].startswith("--rootdir=")


def test_a_failed_check_fails_the_whole(monkeypatch):
    monkeypatch.setattr(subprocess, "run", lambda words, **_: types.SimpleNamespace(returncode=int(words[2] == "mypy")))
    assert cli.main(["test"]) == 1
