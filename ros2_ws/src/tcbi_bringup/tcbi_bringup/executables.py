"""The executables of the workspace, found through the ament index as `ros2 run` does."""

import os
from pathlib import Path

from ament_index_python.packages import PackageNotFoundError, get_package_prefix

from tcbi_bringup.errors import UnknownExecutableError

PACKAGES = ("tcbi_sim", "hexapod_driver", "tcbi_policy", "tcbi_infer", "tcbi_dashboard", "tcbi_bringup")


def executables(package: str) -> dict[str, Path]:
    """Name and path of each executable that a package installs; empty if there is no such package."""
    try:
        folder = Path(get_package_prefix(package)) / "lib" / package
    except (PackageNotFoundError, ValueError):
        return {}
    if not folder.is_dir():
        return {}
    return {file.name: file for file in sorted(folder.iterdir()) if file.is_file() and os.access(file, os.X_OK)}


def find_executable(package: str, name: str) -> Path:
    """Path of `lib/<package>/<name>`.

    Raises:
      UnknownExecutableError: names what there is.
    """
    known = executables(package)
    if name in known:
        return known[name]
    if known:
        raise UnknownExecutableError(f"package {package!r} has no executable {name!r}; it has {', '.join(known)}")
    listing = "; ".join(f"{p}: {', '.join(executables(p))}" for p in PACKAGES if executables(p))
    raise UnknownExecutableError(f"no package {package!r} with executables; there are {listing}")
