"""Model versions on disk: one folder each, written whole or not at all, shared by several processes.

    models/<version>/model.json      what it is: rig, effects, parameters, parent, evidence
    models/<version>/model.xml       MJCF at the mean parameters, which plain MuJoCo loads
    models/<version>/posterior.nc    netCDF: group `posterior` (equally weighted draws, for ArviZ) and group `particles`
    policies/ rollouts/ runs/        of the other packages

The root is `--store`, else the environment variable TCBI_STORE, else ~/.local/share/tcbi.
"""

import dataclasses
import json
import logging
import math
import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from tcbi_sim.errors import SimError, UnknownNameError
from tcbi_sim.mjcf import to_xml
from tcbi_sim.model import Model, base_model, now, parameters_of
from tcbi_sim.parameter import Parameter
from tcbi_sim.places import default_root
from tcbi_sim.rigs import rig_names

log = logging.getLogger(__name__)
FORMAT = 1
LATEST = "latest"
DRAWS = 1000
RESTORE = "restore the file or remove the folder"


def _is(kind: Any) -> Callable[[Any], bool]:
    return lambda value: isinstance(value, kind)


def _is_list(kind: Any) -> Callable[[Any], bool]:
    return lambda value: isinstance(value, list) and all(isinstance(item, kind) for item in value)


def _is_table(kind: Any) -> Callable[[Any], bool]:
    return lambda value: isinstance(value, dict) and all(isinstance(item, kind) for item in value.values())


HEAD: dict[str, tuple[Callable[[Any], bool], str]] = {  # key of model.json: what it must be
    "version": (_is(str), "a text"),
    "rig": (_is(str), "a text"),
    "effects": (_is_list(str), "a list of texts"),
    "parameters": (_is_list(dict), "a list of objects"),
    "parent": (_is(str | None), "a text or null"),
    "evidence": (_is(dict), "an object"),
    "created": (_is(str), "a text"),
    "joint_gains": (_is_list(int | float), "a list of numbers"),
    "fixed": (_is_table(int | float), "an object of numbers"),
}


class StoreError(SimError):
    """A model folder that cannot be read."""


class ModelStore:
    """The versions of all models under one root."""

    def __init__(self, root: Path | str | None = None):
        self.root = Path(root).expanduser() if root else default_root()
        self.models = self.root / "models"

    def folder(self, kind: str) -> Path:
        """A folder of the store, made if missing: `policies`, `rollouts`, `runs`, …"""
        path = self.root / kind
        path.mkdir(parents=True, exist_ok=True)
        return path

    def versions(self, rig: str | None = None) -> list[str]:
        """Known versions of a rig (or of all): version 0, which is built in, then the saved ones by number."""
        built_in = [f"{name}-v0" for name in rig_names() if rig in (None, name)]
        saved = [p.name for p in self.models.glob("*-v*") if (p / "model.json").is_file()]
        if rig:
            saved = [v for v in saved if v.rpartition("-v")[0] == rig]
        return built_in + sorted(saved, key=_number)

    def load(self, version: str = LATEST, rig: str = "hexapod") -> Model:
        """One version; `latest` is the newest of `rig`.

        Raises:
          UnknownNameError: there is no such version.
          StoreError: the rig has no model, or its files are damaged or do not fit the rig and the effects here.
        """
        known = self.versions(rig if version == LATEST else None)
        if not known:
            having = ", ".join(sorted({v.rpartition("-v")[0] for v in self.versions()}))
            raise StoreError(
                f"the rig {rig!r} has no model, so its recordings cannot be simulated; rigs with one: {having}"
            )
        version = known[-1] if version == LATEST else version
        if version not in known:
            raise UnknownNameError("model version", version, known)
        name, _, number = version.rpartition("-v")
        return base_model(name) if number == "0" else self._read(self.models / version)

    def save(self, model: Model) -> Model:
        """Write a model as the next version of its rig and return it under that name.

        A number whose folder holds no model, as an interrupted `rm -r` leaves it, is not given again.

        Raises:
          StoreError: the folder cannot be written.
        """
        try:
            self.models.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryDirectory(prefix=".new-", dir=self.models, ignore_cleanup_errors=True) as work:
                while True:
                    number = 1 + max((0, *self._taken(model.rig)))
                    named = dataclasses.replace(model, version=f"{model.rig}-v{number}", created=model.created or now())
                    self._write(Path(work), named)
                    if _moved(Path(work), self.models / named.version):
                        return named
        except OSError as e:
            raise StoreError(f"cannot write {self.models}: {e.strerror}; free space or choose --store") from e

    def _taken(self, rig: str) -> list[int]:
        """Numbers of a rig that something in the folder has, be it a model or not."""
        return [_number(p.name) for p in self.models.glob("*-v*") if p.name.rpartition("-v")[0] == rig]

    def history(self, rig: str | None = None) -> list[Model]:
        """All versions, oldest first; one that cannot be read is left out with a line in the log."""
        models = []
        for version in self.versions(rig):
            try:
                models.append(self.load(version))
            except SimError as e:
                log.warning("tcbi: %s is left out: %s", version, " ".join(str(e).split()))
        return models

    def delete(self, version: str) -> None:
        """Delete a saved version that no other has as its parent, also one whose files are damaged.

        Its empty folder stays, so that its number, which policies and diagnoses may name, is not given again.

        Raises:
          UnknownNameError: there is no such version.
          StoreError: it is built in, has children, or its files cannot be deleted.
        """
        known = self.versions()
        if version not in known:
            raise UnknownNameError("model version", version, known)
        if version.endswith("-v0"):
            raise StoreError(f"{version} is built in and cannot be deleted")
        children = [m.version for m in self.history(version.rpartition("-v")[0]) if m.parent == version]
        if children:
            raise StoreError(f"{version} is the parent of {', '.join(children)}; delete those first")
        folder = self.models / version
        try:
            (folder / "model.json").unlink()  # first: without it the folder is no version
            for path in folder.iterdir():
                shutil.rmtree(path) if path.is_dir() else path.unlink()
        except OSError as e:
            raise StoreError(f"cannot delete {e.filename or folder}: {e.strerror}") from e

    def _write(self, folder: Path, model: Model) -> None:
        head = {
            "format": FORMAT,
            "version": model.version,
            "rig": model.rig,
            "effects": list(model.effects),
            "parent": model.parent,
            "created": model.created,
            "parameters": [dataclasses.asdict(p) for p in model.parameters],
            "mean": dict(zip(model.names, map(float, model.mean()), strict=True)),
            "joint_gains": list(model.joint_gains),
            "fixed": model.fixed,
            "evidence": model.evidence,
        }
        (folder / "model.json").write_text(json.dumps(head, indent=1, default=_plain) + "\n")
        (folder / "model.xml").write_text(to_xml(model))
        write_posterior(folder / "posterior.nc", model)

    @staticmethod
    def _read(folder: Path) -> Model:
        path, particles = folder / "model.json", folder / "posterior.nc"
        try:
            head = json.loads(path.read_text())
            if isinstance(head, dict):
                head.setdefault("joint_gains", [])  # versions from before there were any
                head.setdefault("fixed", {})
            check_head(path, head)
            if not particles.exists():
                raise StoreError(f"{particles} is missing; {RESTORE}")
            values, log_weights = read_particles(particles)
        except (OSError, KeyError, TypeError, ValueError) as e:
            raise StoreError(f"cannot read the model in {folder}: {e}; remove the folder or restore its files") from e
        rig, effects = head["rig"], tuple(head["effects"])
        try:
            parameters = parameters_of(rig, effects, head["fixed"])
        except SimError as e:
            raise StoreError(
                f"model {head['version']} needs a rig or an effect that is not here, or not for it any more: {e}; name "
                f"another version, or remove {folder}"
            ) from e
        check_parameters(path, head["parameters"], parameters)
        about = (head["parent"], head["evidence"], head["created"])
        try:
            model = Model(head["version"], rig, effects, parameters, values, log_weights, *about, fixed=head["fixed"])
        except SimError as e:
            raise StoreError(f"{particles}: {e}; {RESTORE}") from e
        try:
            model = dataclasses.replace(model, joint_gains=tuple(head["joint_gains"]))
        except SimError as e:
            raise StoreError(f"{path}: {e}; {RESTORE}") from e
        check_mean(path, head.get("mean", {}), model)
        return model


def check_head(path: Path, head: Any) -> None:
    """Refuse a `model.json` of another format or with values of wrong types.

    Raises:
      StoreError: names all of them.
    """
    if not isinstance(head, dict):
        raise StoreError(f"{path}: got {type(head).__name__}, allowed is an object; {RESTORE}")
    if head.get("format") != FORMAT:
        raise StoreError(
            f"{path} has format {head.get('format')!r}, allowed is {FORMAT}; load it with the release of tcbi that "
            "wrote it, or remove the folder"
        )
    faults = [
        f"{key} is {head.get(key)!r}, allowed is {allowed}"
        for key, (fits, allowed) in HEAD.items()
        if not fits(head.get(key))
    ]
    if faults:
        raise StoreError(f"{path}: {'; '.join(faults)}; {RESTORE}")


def check_parameters(path: Path, saved: list[dict[str, Any]], defined: tuple[Parameter, ...]) -> None:
    """Refuse a `model.json` whose parameters are not those of its rig and its effects.

    Their bounds are not read from the file: values are held against those that the rig and the effects have now.

    Raises:
      StoreError: names both.
    """
    names, allowed = [p.get("name") for p in saved], [p.name for p in defined]
    if names != allowed:
        raise StoreError(
            f"{path}: parameters are {', '.join(map(str, names)) or 'none'}, allowed are {', '.join(allowed)}; the "
            "rig, an effect or this file has changed since it was saved; put that back or remove the folder"
        )


def check_mean(path: Path, saved: dict[str, Any], model: Model) -> None:
    """Refuse a `model.json` whose mean is edited: it repeats what the particles say, and only these count.

    Raises:
      StoreError: names both.
    """
    for name, value in zip(model.names, model.mean(), strict=True):
        said = saved.get(name, value)
        if not isinstance(said, int | float) or not math.isclose(said, value, rel_tol=1e-3, abs_tol=1e-9):
            raise StoreError(
                f"{path}: mean {name} is {said!r}, allowed is {value:.6g}, which the particles in posterior.nc give; a "
                f"version is changed by a fit alone (./tcbi infer, ./tcbi add); {RESTORE}"
            )


def read_particles(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Particles (N, P) and log-weights (N,) of a saved model."""
    import xarray as xr  # takes a second, which nodes on a built-in model need not wait for

    with xr.open_dataset(path, group="particles", engine="h5netcdf") as particles:  # netCDF4 is not safe in threads
        return particles["value"].values.astype(float), particles["log_weight"].values.astype(float)


def write_posterior(path: Path, model: Model, seed: int = 0) -> None:
    """Particles with log-weights, and equally weighted draws that ArviZ opens (`az.from_netcdf`)."""
    import xarray as xr

    draws = model.sample(np.random.default_rng(seed), DRAWS)
    posterior = xr.Dataset(
        {p.name: (("chain", "draw"), draws[None, :, i], {"units": p.unit}) for i, p in enumerate(model.parameters)}
    )
    particles = xr.Dataset(
        {"value": (("particle", "parameter"), model.particles), "log_weight": ("particle", model.log_weights)},
        coords={"parameter": list(model.names)},
        attrs={"model": model.version},
    )
    tree = xr.DataTree.from_dict({"posterior": posterior, "particles": particles})
    tree.to_netcdf(path, engine="h5netcdf")


def _moved(work: Path, place: Path) -> bool:
    """Rename a folder, unless somebody was faster."""
    try:
        os.rename(work, place)
    except OSError:
        if not place.exists():
            raise
        return False
    return True


def _number(version: str) -> int:
    number = version.rpartition("-v")[2]
    return int(number) if number.isdigit() else -1


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return dataclasses.asdict(value)
    raise TypeError(f"cannot write a {type(value).__name__} as JSON")
