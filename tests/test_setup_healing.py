"""A set-up that was cut off, or whose folder was moved, heals at the next call; a full disk is told beforehand."""

import shutil
import sys
from collections import namedtuple
from pathlib import Path

import pytest

from tcbi_setup import __main__ as setup
from tcbi_setup import environment, layout, workspace
from tcbi_setup.layout import SetupError, read, write

MAKING, INSTALLING, BUILDING = "making .venv", "installing the locked packages", "building the workspace"
Disk = namedtuple("Disk", "total used free")


class Steps:
    """Stands for the programs of the set-up: notes each step, leaves what it would leave, fails where it is told to."""

    def __init__(self, checkout: Path) -> None:
        self.taken: list[str] = []
        self.failing = ""
        self.venv = checkout / ".venv"
        self.workspace = checkout / ".tcbi" / "ws"
        self.packages = ("one", "two")
        self.leftovers: list[Path] = []  # of an earlier build, as this build found them

    def run(self, step: str, *_: object) -> str:
        self.taken.append(step)
        if step == MAKING:
            (self.venv / "bin").mkdir(parents=True)
            (self.venv / "bin" / "python").symlink_to(sys.executable)
        if step == BUILDING:
            self.leftovers = sorted(self.workspace.glob("*/*/half-made"))
            for folder in (self.workspace / kind / name for kind in ("build", "install") for name in self.packages):
                folder.mkdir(parents=True, exist_ok=True)
                (folder / "half-made").touch()
        if step == self.failing:
            raise SetupError(f"{step} failed")
        return ""


@pytest.fixture
def steps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Steps:
    """A checkout of two packages in a folder of its own."""
    private, venv = tmp_path / ".tcbi", tmp_path / ".venv"
    steps = Steps(tmp_path)
    for name in steps.packages:
        write(tmp_path / "src" / name / "package.xml", "<package/>")
    for lock in ("requirements.lock", "requirements-cuda.lock"):
        (tmp_path / lock).touch()
    monkeypatch.setattr(layout, "ROOT", tmp_path)
    monkeypatch.setattr(layout, "PRIVATE", private)
    monkeypatch.setattr(environment, "ROOT", tmp_path)
    monkeypatch.setattr(environment, "LOCK", tmp_path / "requirements.lock")
    monkeypatch.setattr(environment, "CUDA_LOCK", tmp_path / "requirements-cuda.lock")
    monkeypatch.setattr(environment, "VENV", venv)
    monkeypatch.setattr(environment, "PYTHON", venv / "bin" / "python")
    monkeypatch.setattr(environment, "_boot", dict)
    monkeypatch.setattr(environment, "_torch_arguments", lambda torch, _: ([], torch))
    monkeypatch.setattr(environment, "patch_cmake_files", lambda: None)
    monkeypatch.setattr(workspace, "SOURCE", tmp_path / "src")
    monkeypatch.setattr(workspace, "WORKSPACE", private / "ws")
    monkeypatch.setattr(workspace, "_captured_environment", lambda: "")
    for module in (setup, environment, workspace):
        monkeypatch.setattr(module, "STATE", private / "state")
    for module in (environment, workspace):
        monkeypatch.setattr(module, "run", steps.run)
    return steps


def cut_off(steps: Steps, step: str, call) -> None:
    """Let the set-up end within one step."""
    steps.failing = step
    with pytest.raises(SetupError):
        call()
    steps.failing, steps.taken = "", []


def test_an_environment_that_was_cut_off_is_made_anew_with_all_that_was_built_on_it(steps):
    workspace.build("e")
    cut_off(steps, INSTALLING, lambda: environment.install("cpu"))
    (steps.venv / "half-made").touch()
    workspace.build("e")
    steps.taken = []
    assert environment.install("cpu")
    assert steps.taken == [MAKING, INSTALLING]
    assert not (steps.venv / "half-made").exists() and not steps.workspace.exists()
    assert not environment.install("cpu"), "what is whole is left alone"


def test_a_whole_environment_is_kept_when_its_lock_changes(steps):
    environment.install("cpu")
    (steps.venv / "kept").touch()
    steps.taken = []
    assert environment.install("cuda")
    assert steps.taken == [INSTALLING] and (steps.venv / "kept").exists()


@pytest.mark.parametrize("harm", ["moved", "broken"])
def test_an_environment_of_another_place_or_without_its_interpreter_is_made_anew(steps, harm):
    environment.install("cpu")
    if harm == "moved":
        write(environment.STATE / "root", "/another/place\n")
    else:
        environment.PYTHON.unlink()
        environment.PYTHON.symlink_to("/no/such/interpreter")
    (environment.STATE / "environment").unlink()
    (steps.venv / "old").touch()
    steps.taken = []
    assert environment.install("cpu")
    assert steps.taken == [MAKING, INSTALLING] and not (steps.venv / "old").exists()


def test_packages_whose_build_was_cut_off_are_built_from_nothing(steps):
    cut_off(steps, BUILDING, lambda: workspace.build("e"))
    assert len(list(steps.workspace.glob("*/*/half-made"))) == 4
    assert workspace.build("e") == ["one", "two"]
    assert not steps.leftovers
    assert workspace.build("e") == []
    write(workspace.SOURCE / "two" / "package.xml", "<package>changed</package>")
    assert workspace.build("e") == ["two"]
    assert len(steps.leftovers) == 4, "after a build that came to its end, nothing is thrown away"


def test_a_package_whose_build_was_cut_off_is_built_though_its_files_are_as_they_were(steps):
    workspace.build("e")
    before = read(workspace.SOURCE / "two" / "package.xml")
    write(workspace.SOURCE / "two" / "package.xml", "<package>changed</package>")
    cut_off(steps, BUILDING, lambda: workspace.build("e"))
    write(workspace.SOURCE / "two" / "package.xml", before)
    assert workspace.build("e") == ["two"]
    assert workspace.build("e") == []


@pytest.mark.parametrize("step", [INSTALLING, BUILDING])
def test_a_set_up_that_was_cut_off_does_not_count_as_the_one_before_it(steps, step, monkeypatch):
    monkeypatch.setattr(environment, "_check_space", lambda _: None)
    monkeypatch.setenv("TCBI_TORCH", "cpu")
    setup.set_up("before")
    assert read(setup.STATE / "stamp") == "before\ncpu\n"
    monkeypatch.setenv("TCBI_TORCH", "cuda")
    cut_off(steps, step, lambda: setup.set_up("after"))
    assert not (setup.STATE / "stamp").exists()
    setup.set_up("after")
    assert read(setup.STATE / "stamp") == "after\ncuda\n"


def test_a_full_disk_is_told_before_anything_is_fetched(steps, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda _: Disk(10**12, 10**12, 3_900_000_000))
    with pytest.raises(SetupError, match=r"has 3\.9 GB free, but 4 GB are needed; make room"):
        environment.install("cpu")
    assert INSTALLING not in steps.taken and not read(environment.STATE / "environment")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: Disk(10**12, 10**12, 4_100_000_000))
    assert environment.install("cpu")
    with pytest.raises(SetupError, match=r"4\.1 GB free, but 12 GB"):
        environment.install("cuda")
