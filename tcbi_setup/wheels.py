"""The ROS wheels carry two paths of the machine that built them; this writes this machine's instead."""

import re
import subprocess
from pathlib import Path

from tcbi_setup.layout import PYTHON, VENV, write

_INCLUDE = re.compile(r"/opt/python/cp\d+-cp\d+/include/python3\.\d+")
_NUMPY = re.compile(r"/opt/python/cp\d+-cp\d+/lib/python3\.\d+/site-packages/numpy/_core/include")
_ASK = "import sysconfig, numpy; print(sysconfig.get_paths()['include']); print(numpy.get_include())"


def patched(text: str, include: str, numpy_include: str) -> str:
    """The text of a cmake file with this interpreter's include folders."""
    return _INCLUDE.sub(lambda _: include, _NUMPY.sub(lambda _: numpy_include, text))


def patch_cmake_files(prefix: Path = VENV) -> int:
    """Rewrite every cmake file below `prefix`/share that needs it; returns how many.

    A new file replaces the old one, because uv links files into its cache.
    """
    include, numpy_include = subprocess.run(
        [PYTHON, "-c", _ASK], capture_output=True, text=True, check=True
    ).stdout.split("\n")[:2]
    count = 0
    for file in (prefix / "share").rglob("*.cmake"):
        text = file.read_text(encoding="utf-8")
        changed = patched(text, include, numpy_include)
        if changed != text:
            write(file, changed)
            count += 1
    return count
