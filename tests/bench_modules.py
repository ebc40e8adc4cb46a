"""Modules of a benchmark, as its script sees them."""

import importlib
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

BENCH = Path(__file__).resolve().parents[1] / "bench"


@contextmanager
def bench_modules(folder: Path, names: tuple[str, ...]) -> Iterator[dict[str, ModuleType]]:
    """Modules by name, found in a folder; afterwards they, and what they import of benchmarks, are forgotten."""
    before = set(sys.modules)
    sys.path.insert(0, str(folder))
    try:
        yield {name: importlib.import_module(name) for name in names}
    finally:
        sys.path.remove(str(folder))
        for name in set(sys.modules) - before:
            if Path(getattr(sys.modules[name], "__file__", None) or "").is_relative_to(BENCH):
                del sys.modules[name]
