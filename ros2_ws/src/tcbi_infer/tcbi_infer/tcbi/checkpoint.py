"""Saving a method's state between generations: NamedTuples of arrays to one .npz file and back, without pickle.

Field `z` of the state is the entry `z`, field `counts` of its field `features` is `features.counts`, and the third
element of a tuple is `proposals.2.centers`.
"""

import typing
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from tcbi_contract.files import replacement

FORMAT = 1


def save(path: Path, state: Any) -> None:
    """Write a state, whole or not at all."""
    arrays: dict[str, np.ndarray] = {"format": np.array(FORMAT)}
    _flatten(state, "", arrays)
    with replacement(path) as work:
        np.savez(work, **arrays)  # type: ignore[arg-type]


def load(path: Path, state_type: type) -> Any | None:
    """The state, or None if there is none, or it is damaged or of another format: then one starts over."""
    try:
        with path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        return _build(state_type, "", arrays) if int(arrays["format"]) == FORMAT else None
    except (OSError, KeyError, ValueError, zipfile.BadZipFile, EOFError):
        return None


def _flatten(value: Any, prefix: str, out: dict[str, np.ndarray]) -> None:
    if hasattr(value, "_fields"):
        for name in value._fields:
            _flatten(getattr(value, name), f"{prefix}{name}.", out)
    elif isinstance(value, tuple):
        out[f"{prefix}length"] = np.array(len(value))
        for i, item in enumerate(value):
            _flatten(item, f"{prefix}{i}.", out)
    else:
        out[prefix.rstrip(".")] = np.asarray(value)


def _build(kind: Any, prefix: str, arrays: dict[str, np.ndarray]) -> Any:
    if hasattr(kind, "_fields"):
        hints = typing.get_type_hints(kind)
        return kind(**{name: _build(hints[name], f"{prefix}{name}.", arrays) for name in kind._fields})
    if typing.get_origin(kind) is tuple:
        item = typing.get_args(kind)[0]
        return tuple(_build(item, f"{prefix}{i}.", arrays) for i in range(int(arrays[f"{prefix}length"])))
    value = arrays[prefix.rstrip(".")]
    return kind(value.item()) if kind in (int, float, bool) else value
