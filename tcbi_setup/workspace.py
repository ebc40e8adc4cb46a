"""The colcon build of ros2_ws into .tcbi/ws, and the environment that it gives."""

import os
import shlex
import subprocess
from pathlib import Path

from tcbi_setup.layout import LOG, PYTHON, SOURCE, STATE, VENV, WORKSPACE, SetupError, digest, read, remove, write
from tcbi_setup.progress import run

_INTERFACES = ("msg/*.msg", "srv/*.srv", "action/*.action")
_INPUTS = ("package.xml", "setup.py", "setup.cfg", "CMakeLists.txt", "resource/*", *_INTERFACES)
_PREFIXES = ("AMENT_PREFIX_PATH", "CMAKE_PREFIX_PATH", "COLCON_PREFIX_PATH")
_CAPTURED = (*_PREFIXES, "LD_LIBRARY_PATH", "PYTHONPATH", "PKG_CONFIG_PATH")


def packages() -> list[Path]:
    """Folders of the packages in the workspace."""
    return sorted(file.parent for file in SOURCE.glob("*/package.xml"))


def key(package: Path, environment: str) -> str:
    """What a built package was made from."""
    return digest((file for pattern in _INPUTS for file in package.glob(pattern)), environment)


def outdated(environment: str) -> dict[Path, str]:
    """Packages to build, each with the key to record when it is built."""
    keys = {package: key(package, environment) for package in packages()}
    return {package: k for package, k in keys.items() if not _is_built(package.name, k)}


def _is_built(name: str, key: str) -> bool:
    cut_off = name in read(STATE / "building").split()
    return not cut_off and read(STATE / "packages" / name) == key and (WORKSPACE / "install" / name).is_dir()


def forget() -> None:
    """Drop everything that is built: it belongs to an environment that is no more."""
    remove(STATE / "packages")
    remove(WORKSPACE)


def build(environment: str) -> list[str]:
    """Build what is out of date; returns the names. An unfinished build starts anew."""
    todo = outdated(environment)
    if todo:
        building = STATE / "building"
        for name in read(building).split():
            remove(WORKSPACE / "build" / name)
            remove(WORKSPACE / "install" / name)
        write(building, " ".join(package.name for package in todo))
        run(
            "building the workspace",
            _command([p.name for p in todo]),
            _variables(),
            f"mend what it names; see {LOG.name}",
        )
        for package, k in todo.items():
            write(STATE / "packages" / package.name, k)
        building.unlink()
    write(STATE / "environment.sh", _captured_environment())
    return [package.name for package in todo]


def _command(names: list[str]) -> list[str | Path]:
    return [
        *(VENV / "bin" / "colcon", "--log-base", WORKSPACE / "log", "build", "--symlink-install"),
        *("--base-paths", SOURCE, "--build-base", WORKSPACE / "build", "--install-base", WORKSPACE / "install"),
        *("--event-handlers", "console_direct+", "--packages-select", *names),
        *("--cmake-args", f"-DPython3_EXECUTABLE={PYTHON}", "-DBUILD_TESTING=OFF", "-Wno-dev", "--no-warn-unused-cli"),
    ]


def _variables() -> dict[str, str]:
    variables = {
        "AMENT_PREFIX_PATH": str(VENV),
        "CMAKE_PREFIX_PATH": str(VENV),
        "PATH": f"{VENV}/bin:{os.environ.get('PATH', os.defpath)}",
        "HOME": os.environ.get("HOME", str(WORKSPACE)),
        "LANG": "C.UTF-8",
        "PYTHONWARNINGS": "ignore",
        "MAKEFLAGS": f"-j{os.cpu_count() or 2}",  # colcon's own choice waits whenever the machine is loaded
    }
    for name in ("TMPDIR", "CC", "CXX", "CMAKE_GENERATOR"):
        if name in os.environ:
            variables[name] = os.environ[name]
    return variables


def _captured_environment() -> str:
    """Shell lines with what `local_setup.bash` would set, so that no later call has to run it."""
    script = WORKSPACE / "install" / "local_setup.bash"
    command = ["bash", "-c", f". {shlex.quote(str(script))} >/dev/null && env -0"]
    result = subprocess.run(command, env=_variables(), capture_output=True, text=True, check=False)
    found = dict(item.partition("=")[::2] for item in result.stdout.split("\0"))
    if result.returncode or str(WORKSPACE) not in found.get("AMENT_PREFIX_PATH", ""):
        raise SetupError(f"sourcing {script} failed: {result.stderr.strip()[-300:]}; remove {WORKSPACE} and call again")
    return "".join(
        f"export {name}={shlex.quote(found[name].strip(os.pathsep))}\n" for name in _CAPTURED if found.get(name)
    )
