"""The set-up's own parts: what it says of a machine, what it passes on to uv, what it rewrites."""

import fcntl
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tcbi_setup import environment, layout, workspace
from tcbi_setup.indexes import uv_environment
from tcbi_setup.layout import SetupError, digest, read, remove, write
from tcbi_setup.progress import run
from tcbi_setup.wheels import patched

ROOT = Path(__file__).resolve().parents[1]
BASICS = ("bash", "env", "dirname", "readlink", "uname", "sha256sum", "python3")


@pytest.fixture
def bare_checkout(tmp_path: Path) -> Path:
    """The entry script and the set-up alone, never set up."""
    checkout = tmp_path / "checkout"
    checkout.mkdir()
    for name in ("tcbi", "requirements.lock", "requirements-cuda.lock"):
        shutil.copy(ROOT / name, checkout)
    shutil.copytree(ROOT / "tcbi_setup", checkout / "tcbi_setup", ignore=shutil.ignore_patterns("__pycache__"))
    return checkout


def call(checkout: Path, programs: tuple[str, ...], **variables: str) -> subprocess.CompletedProcess:
    """`./tcbi --help` on a machine that has these programs only."""
    path = checkout.parent / "bin"
    path.mkdir(exist_ok=True)
    for name in programs:
        found = os.path.realpath(shutil.which(name) or pytest.fail(f"{name} is needed for this test"))
        if not (path / name).exists():
            (path / name).symlink_to(found)
    command = [str(path / "bash"), str(checkout / "tcbi"), "--help"]
    home = {"HOME": str(checkout.parent), "PATH": str(path)}
    return subprocess.run(command, env=home | variables, capture_output=True, text=True, timeout=60, check=False)


def test_all_that_is_missing_is_named_at_once_with_its_remedy(bare_checkout):
    result = call(bare_checkout, BASICS)
    assert result.returncode == 1
    assert "g++, cmake, make" in result.stderr and "sudo apt install g++ cmake make" in result.stderr
    assert len(result.stderr.strip().splitlines()) == 1


def test_an_interpreter_that_was_asked_for_and_does_not_fit_is_refused(bare_checkout):
    result = call(bare_checkout, BASICS, TCBI_PYTHON="python9.9")
    assert result.returncode == 1
    assert "TCBI_PYTHON=python9.9 is not 3.11, 3.12 or 3.13" in result.stderr


def test_a_machine_without_a_python_is_told_which_packages_to_get(bare_checkout):
    old = bare_checkout.parent / "bin" / "python3"
    old.parent.mkdir()
    old.write_text("#!/bin/sh\nexit 1\n")  # as one does that does not fit
    old.chmod(0o755)
    result = call(bare_checkout, BASICS)
    assert result.returncode == 1
    assert "Python 3.11 or newer" in result.stderr
    assert "sudo apt install python3 python3-venv python3-dev g++" in result.stderr


def test_a_newer_python_alone_is_enough_to_fetch_one_that_the_wheels_are_for(bare_checkout, tmp_path, monkeypatch):
    monkeypatch.setattr(environment, "FITTING", ((3, 8), (3, 9)))
    commands = []
    monkeypatch.setattr(
        environment, "run", lambda step, command, variables, remedy: commands.append((command, variables))
    )
    environment._make(Path("uv"), {"PATH": "here"})
    ((command, variables),) = commands
    assert command[:5] == [Path("uv"), "venv", "--managed-python", "--python", "3.12"]
    assert variables == {"PATH": "here", "UV_PYTHON_INSTALL_DIR": str(layout.FETCHED_PYTHON)}
    newer = bare_checkout.parent / "bin" / "python3"
    newer.parent.mkdir()
    newer.write_text(f'#!/bin/sh\ncase "$2" in *"(3, 13)"*) exit 1 ;; esac\nexec {sys.executable} "$@"\n')
    newer.chmod(0o755)
    assert "missing on this machine: g++, cmake, make;" in call(bare_checkout, BASICS).stderr


def test_an_unknown_build_of_torch_is_refused(bare_checkout):
    (bare_checkout.parent / "bin").mkdir()
    for tool in ("g++", "cmake", "make"):  # asked for, not run, before the choice is checked
        program = bare_checkout.parent / "bin" / tool
        program.write_text("#!/bin/sh\nexit 1\n")
        program.chmod(0o755)
    result = call(bare_checkout, BASICS, TCBI_TORCH="rocm")
    assert result.returncode == 1
    assert "got 'rocm', allowed is one of auto, cpu, cuda" in result.stderr
    assert not (bare_checkout / ".venv").exists()


def test_pips_settings_reach_uv_and_uvs_own_stand():
    pip = {"find-links": "folder another", "cert": "bundle.pem", "extra-index-url": "mirror"}
    made = uv_environment({"UV_FIND_LINKS": "mine"}, pip)
    assert made["UV_FIND_LINKS"] == "mine"
    assert (made["SSL_CERT_FILE"], made["UV_INDEX"]) == ("bundle.pem", "mirror")
    assert made["UV_INDEX_STRATEGY"] == "unsafe-best-match"
    assert uv_environment({}, pip)["UV_FIND_LINKS"] == "folder,another"
    assert "UV_INDEX_STRATEGY" not in uv_environment({}, {})


def test_paths_of_the_building_machine_are_rewritten():
    text = (
        'a "/opt/python/cp312-cp312/include/python3.12" '
        'b "/opt/python/cp312-cp312/lib/python3.12/site-packages/numpy/_core/include;x"'
    )
    assert patched(text, "INC", "NUM") == 'a "INC" b "NUM;x"'


def test_a_key_changes_with_content_name_and_words(tmp_path, monkeypatch):
    monkeypatch.setattr(layout, "ROOT", tmp_path)
    file = tmp_path / "a"
    file.write_text("1")
    first = digest([file], "x")
    assert digest([file], "y") != first
    file.write_text("2")
    assert digest([file], "x") != first
    file.write_text("1")
    assert digest([file], "x") == first
    assert digest([file.rename(tmp_path / "b")], "x") != first


def test_a_written_file_is_whole_and_leaves_nothing_beside_it(tmp_path):
    file = tmp_path / "folder" / "state"
    write(file, "one")
    write(file, "two")
    assert read(file) == "two"
    assert [f.name for f in file.parent.iterdir()] == ["state"]
    assert read(tmp_path / "absent") == ""


def test_removal_frees_the_name_and_clears_earlier_leftovers(tmp_path, monkeypatch):
    monkeypatch.setattr(layout, "PRIVATE", tmp_path / "private")
    leftover = tmp_path / "private" / "trash-old"
    leftover.mkdir(parents=True)
    folder = tmp_path / "folder"
    folder.mkdir()
    remove(folder)
    remove(folder)
    assert not folder.exists() and not leftover.exists()


def test_a_failing_step_shows_its_last_lines_and_the_remedy(tmp_path, monkeypatch):
    monkeypatch.setattr("tcbi_setup.progress.LOG", tmp_path / "setup.log")
    with pytest.raises(SetupError, match=r"(?s)thinking failed \(exit 3\); think again.*no idea"):
        run("thinking", ["bash", "-c", "echo no idea; exit 3"], {"PATH": os.environ["PATH"]}, "think again")


SET_UP_OF_ONE_STEP = """
import sys
from pathlib import Path
from tcbi_setup import __main__ as setup, progress
folder = Path(sys.argv[1])
one_process = "import os, time; open('begun', 'w').write(str(os.getpid())); os.rename('begun', 'pid'); time.sleep(60)"
setup.STATE, progress.LOG = folder, folder / "log"
setup.set_up = lambda _: progress.run("waiting", [sys.executable, "-c", one_process], {}, "")
progress.ROOT = folder
sys.exit(setup.main())
"""


def started_set_up(folder: Path) -> tuple[subprocess.Popen, int]:
    """A set-up within its only step, and the process group of that step's program."""
    process = subprocess.Popen([sys.executable, "-c", SET_UP_OF_ONE_STEP, str(folder)], cwd=ROOT)
    deadline = time.monotonic() + 30
    while not (folder / "pid").exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    return process, int((folder / "pid").read_text())


def is_locked(folder: Path) -> bool:
    with (folder / "lock").open() as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_the_program_of_the_present_step_too(tmp_path, number):
    before = signal.signal(number, signal.default_int_handler)  # nohup has SIGHUP ignored, by those started here too
    process, group = started_set_up(tmp_path)
    signal.signal(number, before)
    process.send_signal(number)
    assert process.wait(30) == 130
    with pytest.raises(ProcessLookupError):
        os.killpg(group, 0)
    assert not is_locked(tmp_path)


def test_after_a_kill_the_lock_lasts_as_long_as_the_program(tmp_path):
    process, group = started_set_up(tmp_path)
    process.kill()
    process.wait(30)
    assert is_locked(tmp_path)
    os.killpg(group, signal.SIGKILL)
    deadline = time.monotonic() + 30
    while is_locked(tmp_path) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert not is_locked(tmp_path)


def test_only_what_changed_is_built_again(tmp_path, monkeypatch):
    for name in ("one", "two"):
        (tmp_path / "src" / name / "msg").mkdir(parents=True)
        (tmp_path / "src" / name / "package.xml").write_text("<package/>")
    monkeypatch.setattr(layout, "ROOT", tmp_path)
    monkeypatch.setattr(workspace, "SOURCE", tmp_path / "src")
    monkeypatch.setattr(workspace, "STATE", tmp_path / "state")
    monkeypatch.setattr(workspace, "WORKSPACE", tmp_path / "ws")
    for package, key in workspace.outdated("e").items():
        write(tmp_path / "state" / "packages" / package.name, key)
        (tmp_path / "ws" / "install" / package.name).mkdir(parents=True)
    assert workspace.outdated("e") == {}
    shutil.rmtree(tmp_path / "ws" / "install" / "one")
    assert [p.name for p in workspace.outdated("e")] == ["one"]
    (tmp_path / "ws" / "install" / "one").mkdir()
    (tmp_path / "src" / "two" / "msg" / "New.msg").write_text("bool x")
    assert [p.name for p in workspace.outdated("e")] == ["two"]
    assert [p.name for p in workspace.outdated("another environment")] == ["one", "two"]


def test_an_environment_belongs_to_its_lock_and_its_torch(monkeypatch):
    assert environment.key("cpu") == environment.key("cpu") != environment.key("cuda")
    before = environment.key("cpu")
    monkeypatch.setattr(environment, "UV_VERSION", "another")
    assert environment.key("cpu") != before


def test_the_cuda_lock_adds_to_the_lock_and_repeats_nothing():
    names = [
        {line.partition("==")[0] for line in file.read_text().splitlines() if line[:1].isalnum()}
        for file in (layout.LOCK, layout.CUDA_LOCK)
    ]
    assert "torch" in names[0] and "triton" in names[1]
    assert not names[0] & names[1]
