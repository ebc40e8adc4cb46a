"""The virtual environment: one locked resolve by a pinned uv, with the build of torch that fits the machine."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

from tcbi_setup import workspace
from tcbi_setup.indexes import pip_settings, uv_environment
from tcbi_setup.layout import (
    BOOT,
    CUDA_LOCK,
    FETCHED_PYTHON,
    LOCK,
    PIP_VENV,
    PRIVATE,
    PYTHON,
    ROOT,
    STATE,
    VENV,
    SetupError,
    digest,
    read,
    remove,
    write,
)
from tcbi_setup.progress import run, say
from tcbi_setup.wheels import patch_cmake_files

UV_VERSION = "0.13.8"
FITTING = ((3, 11), (3, 13))  # what the ROS wheels exist for
FETCHED = "3.12"  # where the machine has none of them; Jazzy's own
PROBE_TIMEOUT_S = 30
SPACE_GB = {"cpu": 4.0, "cuda": 12.0}
CUDA_SIZE = "2 GB to fetch, 5 GB on disk"
CHOICES = ("auto", "cpu", "cuda")
NETWORK = "check the network (or pip's index and certificate settings) and call again"


def wanted_torch() -> str:
    """TCBI_TORCH, or what an earlier set-up was asked for, or auto."""
    wanted = os.environ.get("TCBI_TORCH") or (read(STATE / "torch").strip() or "auto")
    if wanted not in CHOICES:
        raise SetupError(f"TCBI_TORCH: got {wanted!r}, allowed is one of {', '.join(CHOICES)}")
    return wanted


def key(torch: str) -> str:
    """What an environment was made from; an equal key means that there is nothing to do."""
    return digest([LOCK, CUDA_LOCK], str(ROOT), torch, UV_VERSION)


def install(torch: str) -> bool:
    """Make the environment if it is not there as it should be; returns whether anything was done."""
    if read(STATE / "environment") == key(torch) and PYTHON.exists():
        return False
    _discard_unfinished()
    environment = _boot()
    uv = BOOT / "bin" / "uv"
    write(STATE / "installing", "an environment that is being made\n")
    (STATE / "environment").unlink(missing_ok=True)
    if not PYTHON.exists():
        workspace.forget()
        _make(uv, environment)
    arguments, size = _torch_arguments(torch, environment)
    _check_space(size)
    options = ["--python", str(PYTHON), "--no-deps", "--build-constraints", str(LOCK)]
    command = [str(uv), "pip", "install", *options, *arguments]
    run("installing the locked packages", command, environment, NETWORK)
    patch_cmake_files()
    write(STATE / "environment", key(torch))
    write(STATE / "torch", torch)
    (STATE / "installing").unlink()
    return True


def _make(uv: Path, environment: dict[str, str]) -> None:
    """The empty environment: of the interpreter that runs this, or where the wheels lack it, of a fetched one."""
    lowest, highest = FITTING
    if lowest <= sys.version_info[:2] <= highest:
        command: list[str | Path] = [uv, "venv", "--python", sys.executable, VENV]
        run("making .venv", command, environment, "remove .venv and call again")
        return
    own = ".".join(str(part) for part in sys.version_info[:2])
    say(f"the ROS wheels are for Python 3.11 to 3.13 and this machine has {own}: fetching {FETCHED} into .tcbi")
    command = [uv, "venv", "--managed-python", "--python", FETCHED, VENV]
    remedy = (
        f"check the network, or get Python {FETCHED} yourself (on Ubuntu from ppa:deadsnakes/ppa: python{FETCHED} "
        f"python{FETCHED}-venv python{FETCHED}-dev; else pyenv or conda) and call with TCBI_PYTHON=/path/to/it"
    )
    run(f"fetching Python {FETCHED}", command, {"UV_PYTHON_INSTALL_DIR": str(FETCHED_PYTHON), **environment}, remedy)


def _discard_unfinished() -> None:
    unfinished = (STATE / "installing").exists()
    moved = read(STATE / "root").strip() not in ("", str(ROOT))
    if VENV.exists() and (unfinished or moved or not _is_usable()):
        say("the environment is incomplete or was moved: making it anew")
        remove(VENV)
    if moved:
        (STATE / "pip").unlink(missing_ok=True)
    write(STATE / "root", f"{ROOT}\n")


def _is_usable() -> bool:
    check = f"import sys; sys.exit(not {FITTING[0]} <= sys.version_info[:2] <= {FITTING[1]})"
    try:
        return subprocess.run([PYTHON, "-I", "-S", "-c", check], check=False).returncode == 0
    except OSError:
        return False


def _boot() -> dict[str, str]:
    """Put the pinned uv into .tcbi/boot; returns the variables to run it with."""
    environment = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")}
    pip = _pip(environment)
    if read(STATE / "boot") != UV_VERSION or not (BOOT / "bin" / "uv").exists():
        remove(BOOT)
        options = ["--quiet", "--disable-pip-version-check", "--no-warn-script-location", "--target", str(BOOT)]
        run("fetching uv", [*pip, "install", *options, f"uv=={UV_VERSION}"], environment, NETWORK)
        write(STATE / "boot", UV_VERSION)
    environment = uv_environment(environment, pip_settings(pip, environment))
    if not os.access(os.path.expanduser("~"), os.W_OK):
        environment.setdefault("UV_CACHE_DIR", str(PRIVATE / "cache"))
    return environment


def _pip(environment: dict[str, str]) -> list[str]:
    """How to call pip: the interpreter's own, or where it has none (as on Debian) that of a small environment."""
    own = [sys.executable, "-m", "pip"]
    if subprocess.run([*own, "--version"], env=environment, capture_output=True, check=False).returncode == 0:
        return own
    if not (STATE / "pip").exists():
        remove(PIP_VENV)
        run("preparing pip", [sys.executable, "-m", "venv", PIP_VENV], environment, "install the venv module of Python")
        write(STATE / "pip", "complete\n")
    return [str(PIP_VENV / "bin" / "python"), "-m", "pip"]


def _torch_arguments(torch: str, environment: dict[str, str]) -> tuple[list[str], str]:
    """uv's arguments and the size class for the build of torch asked for.

    For the processor: a wheel in pip's find-links, else the index that uv knows, else (said openly) the ordinary build
    with its CUDA libraries, which runs on the processor too.
    """
    everything = ["--requirements", str(LOCK), "--requirements", str(CUDA_LOCK)]
    if torch == "cuda":
        return everything, "cuda"
    version = _pinned_torch()
    if _can_install([f"torch=={version}+cpu"], environment):
        return ["--requirements", str(LOCK)], "cpu"
    if _can_install(["--torch-backend=cpu", f"torch=={version}"], environment):
        return ["--torch-backend=cpu", "--requirements", str(LOCK)], "cpu"
    if torch == "cpu":
        raise SetupError(
            f"TCBI_TORCH=cpu: found no CPU build of torch {version} for this Python, neither in pip's find-links nor "
            "in the index that uv knows; allow that index, or use TCBI_TORCH=auto, which takes the ordinary build"
        )
    say(f"no CPU build of torch {version} within reach: taking the ordinary one with CUDA ({CUDA_SIZE})")
    return everything, "cuda"


def _pinned_torch() -> str:
    for line in LOCK.read_text(encoding="utf-8").splitlines():
        if line.startswith("torch=="):
            return line.removeprefix("torch==").split()[0]
    raise SetupError(f"{LOCK.name} pins no torch; restore it from the repository")


def _can_install(requirement: list[str], environment: dict[str, str]) -> bool:
    uv = str(BOOT / "bin" / "uv")
    command = [uv, "pip", "install", "--python", str(PYTHON), "--dry-run", "--reinstall", "--no-deps", *requirement]
    quick = {**environment, "UV_HTTP_TIMEOUT": "10", "UV_HTTP_RETRIES": "0"}
    try:
        return (
            subprocess.run(command, env=quick, capture_output=True, timeout=PROBE_TIMEOUT_S, check=False).returncode
            == 0
        )
    except subprocess.TimeoutExpired:
        return False


def _check_space(size: str) -> None:
    free = shutil.disk_usage(ROOT).free / 1e9
    if free < SPACE_GB[size]:
        raise SetupError(
            f"the disk of {ROOT} has {free:.1f} GB free, but {SPACE_GB[size]:.0f} GB are needed; make room"
        )
