"""From a diagnosis to the next version of the model, its parameters distributed as they were fitted."""

import dataclasses
import datetime
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import betaincinv

from tcbi_contract.files import replace_file
from tcbi_contract.plain import plain
from tcbi_infer.diagnose.diagnosis import diagnose
from tcbi_infer.diagnose.evidence import CANNOT_TELL, NOTHING_MISSING, OUTSIDE_LIBRARY, Diagnosis
from tcbi_infer.diagnose.settings import Settings
from tcbi_infer.errors import InferError
from tcbi_sim.measurement import Measurement
from tcbi_sim.model import Model

PARTICLES = 200
LEAST_ROOM = 1e-6  # of a range, between a fitted value and the bounds, and of its standard deviation
FAR = 1.645  # standard deviations, to the 95 % point
HALVINGS = 40
STAND_OFF = 0.3  # of a standard deviation, between a mean and the bounds
FLAT_SD = 12**-0.5  # of the flat prior, in unit space
PREFIX = "diagnosis-"
DOUBTS = {
    CANNOT_TELL: "could not tell which effect is missing",
    OUTSIDE_LIBRARY: "found that something else is missing",
    NOTHING_MISSING: "found that nothing is missing",
}
MOMENTS = "moments-"  # the worst moments of the diagnosis of the same name


def adopt(model: Model, use: str, diagnosis: Mapping[str, Any], seed: int = 0) -> Model:
    """The model with an effect, distributed as the diagnosis fitted it; unsaved.

    A parameter on which the kinds of motion disagree is as wide as their values are apart.

    Args:
      model: the parent, the same that was diagnosed.
      use: "name" or "name:site"; "" for no new effect, only the parameters as they were fitted.
      diagnosis: as `Diagnosis.to_json` gives it.
      seed: of the particles.

    Raises:
      InferError: the diagnosis is of another model, or did not fit this use.
    """
    if diagnosis["model"] != model.version:
        raise InferError(
            f"the diagnosis is of model {diagnosis['model']!r}, not of {model.version!r}; "
            "diagnose this model, or give --model"
        )
    fitted = [e for e in diagnosis["ranking"] if e["refined"]]
    evidence = next((e for e in fitted if e["use"] == use), None) if use else diagnosis["base"]
    if evidence is None:
        known = ", ".join(e["use"] for e in fitted) or "none"
        raise InferError(f"the diagnosis fitted {known}, but not {use!r}; give bags to fit it now")
    child = model.with_effect(use) if use else model
    doubted = disagreements(diagnosis, use)
    values = np.array(evidence["values"])
    particles = draw(child, values, _reaching(child, values, np.array(evidence["spread"]), doubted), seed)
    log_weights = np.full(len(particles), -np.log(len(particles)))
    summary = {
        "kind": "diagnosis",
        "use": use,
        "verdict": diagnosis["verdict"],
        "statement": diagnosis["statement"],
        "accepted": evidence["accepted"],
        "rollouts": [r for r in diagnosis["rollouts"] if r not in diagnosis["sealed"]],
        "sealed": diagnosis["sealed"],
        "errors": {**diagnosis["errors"], use or "base": evidence["error_after"]},
        "error_over_floor": evidence["error_after"],
        "floor_from_replicates": diagnosis["floor_from_replicates"],
        "nothing_held_out": diagnosis.get("nothing_held_out", False),
        "parameters": evidence["parameters"],
        "disagreements": [f"{a['statement']} Its interval reaches over all of them." for a in doubted],
    }
    fitted_again = child.with_particles(particles, log_weights, **summary)
    return dataclasses.replace(fitted_again, joint_gains=tuple(evidence.get("joint_gains") or model.joint_gains))


def doubt(evidence: Mapping[str, Any]) -> str:
    """What a diagnosis that made a version says against its effect; empty where it named that effect alone."""
    if not evidence["accepted"]:
        return "did not accept it"
    return DOUBTS.get(evidence["verdict"], "")


def offered(model: Model, use: str, diagnosis: Mapping[str, Any]) -> Model:
    """As `adopt`, of a diagnosis whose kinds of motion agree on the effect's sizes.

    Raises:
      InferError: they do not, or as `adopt` says.
    """
    child = adopt(model, use, diagnosis)  # a diagnosis of another model is told first
    if told := objection(diagnosis, use):
        raise InferError(told)
    return child


def disagreements(diagnosis: Mapping[str, Any], use: str) -> list[Mapping[str, Any]]:
    """Parameters of the model with a use on which the kinds of motion disagree; none in an older diagnosis."""
    return [a for a in diagnosis.get("agreement", {}).get(use, ()) if a["agrees"] is False]


def objection(diagnosis: Mapping[str, Any], use: str) -> str:
    """Why the sizes that a diagnosis fitted to an effect are not offered for use; empty where they are."""
    own = [p["name"] for e in diagnosis["ranking"] if e["use"] == use for p in e["parameters"]]
    told = [a["statement"] for a in disagreements(diagnosis, use) if a["name"] in own]
    if not told:
        return ""
    return (
        f"{use} is not offered for use. {' '.join(told)} See the values in the report, and look for what else "
        "differs between these motions; or add it all the same with "
        f"`./tcbi add {use} --anyway`"
    )


def _reaching(model: Model, values: np.ndarray, spread: np.ndarray, doubted: Sequence[Mapping[str, Any]]) -> np.ndarray:
    """(P, P) the spread, the 90 % interval of each doubted parameter reaching to the value of every kind of motion."""
    names, wider = [p.name for p in model.parameters], np.ones(len(values))
    for told in doubted:
        i = names.index(told["name"])
        ends = np.array([kind["value"] for kind in told["kinds"]])
        reach = np.max(np.abs(model.parameters[i].to_unit(ends) - model.parameters[i].to_unit(values[i])))
        wider[i] = max(reach / FAR / max(np.sqrt(spread[i, i]), LEAST_ROOM), 1.0)
    return spread * np.outer(wider, wider)


def draw(model: Model, values: np.ndarray, spread: np.ndarray, seed: int) -> np.ndarray:
    """(N, P) draws whose means, in unit space, are the fitted values, and that stay within the bounds.

    Each parameter has a Beta distribution, which far from the bounds is nearly a Gaussian. Beside a bound its far end
    is that of the 90 % interval, as far as this mean and a single peak, perhaps at the bound, allow; it is nowhere
    wider than the flat prior, and a mean at a bound stands off by a share of the spread, without which there is none.
    Evenly spaced quantiles of each are joined with the rank correlation of Gaussian draws.

    Args:
      model: with the effect.
      values: (P,) as fitted, physical.
      spread: (P, P) their covariance in unit space.
      seed: of the draws.
    """
    joint = np.random.default_rng(seed).multivariate_normal(np.zeros(len(values)), spread, PARTICLES, method="eigh")
    share = (joint.argsort(axis=0).argsort(axis=0) + 0.5) / PARTICLES
    sd = np.maximum(np.sqrt(np.diag(spread)), LEAST_ROOM)
    room = np.clip(STAND_OFF * sd, LEAST_ROOM, STAND_OFF * FLAT_SD)
    mean = np.clip(model.to_unit(values), room, 1.0 - room)
    count = _count(mean, sd)
    return model.from_unit(betaincinv(mean * count, (1.0 - mean) * count, share))


def _count(mean: np.ndarray, sd: np.ndarray) -> np.ndarray:
    """(P,) sums of the two shapes of Beta distributions with these means, in unit space."""
    near = np.minimum(mean, 1.0 - mean)  # as if the nearer bound were 0
    end = np.minimum(near + FAR * sd, 1.0)
    gaussian = near * (1.0 - near) / sd**2 - 1.0
    few, many = np.maximum(gaussian, 1.0 / (1.0 - near)), np.maximum(gaussian, 1.0 / near)  # fewer: a peak at a bound
    for _ in range(HALVINGS):
        middle = np.sqrt(few * many)
        reaches = betaincinv(near * middle, (1.0 - near) * middle, 0.95) >= end
        few, many = np.where(reaches, middle, few), np.where(reaches, many, middle)
    return many


def fit_effect(model: Model, use: str, measurements: Sequence[Measurement], **options: Any) -> Diagnosis:
    """A diagnosis of a single candidate: its fit, held-out gain and intervals."""
    return diagnose(model, measurements, uses=[use], settings=Settings(refine=1), **options)


def remember(diagnosis: Diagnosis, folder: Path) -> Path:
    """Write a diagnosis, and its worst moments, beside the others; returns its path.

    Raises:
      InferError: the folder cannot be written.
    """
    stamp = datetime.datetime.now(datetime.UTC).strftime("%Y%m%dT%H%M%S%f")
    path = folder / f"{PREFIX}{diagnosis.model}-{stamp}.json"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        moments = path.with_name(path.name.replace(PREFIX, MOMENTS))
        for place, text in (
            (moments, json.dumps([_short(plain(moment)) for moment in diagnosis.moments])),
            (path, json.dumps(diagnosis.to_json(), indent=1) + "\n"),
        ):
            replace_file(place, text)
    except OSError as e:
        raise InferError(f"cannot write {path}: {e.strerror}; free space or choose --store") from e
    return path


def _short(value: Any) -> Any:
    """Plain values with numbers of five digits."""
    if isinstance(value, dict):
        return {k: _short(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_short(v) for v in value]
    return float(f"{value:.5g}") if isinstance(value, float) else value


def read(path: Path) -> dict[str, Any]:
    """A diagnosis that was written before.

    Raises:
      InferError: it is no such file.
    """
    try:
        diagnosis = json.loads(path.read_text())
        missing = {"model", "verdict", "statement", "ranking", "rollouts", "sealed", "errors"} - set(diagnosis)
    except (OSError, ValueError, TypeError) as e:
        raise InferError(f"cannot read the diagnosis {path}: {e}; write one with `diagnose --json`") from e
    if missing:
        raise InferError(f"{path} is no diagnosis: it lacks {', '.join(sorted(missing))}")
    return diagnosis


def latest(folder: Path, model: str, use: str) -> dict[str, Any] | None:
    """The newest remembered diagnosis of a model that fitted this use."""
    for path in sorted(folder.glob(f"{PREFIX}{model}-*.json"), reverse=True):
        diagnosis = read(path)
        if any(e["refined"] and e["use"] == use for e in diagnosis["ranking"]):
            return diagnosis
    return None
