"""What the Add view tells of the store's versions: read in a thread, since its libraries take a second to load."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from tcbi_dashboard.names import MEASURED
from tcbi_sim.store import ModelStore

DRAWS = 300


def errors(store: ModelStore, rig: str) -> list[dict[str, Any]]:
    """Each version with its error: as last measured on unseen rollouts, else as its diagnosis kept it."""
    from tcbi_infer.compare.history import history

    models = store.history(rig)
    measured = _measured(store.root / "runs" / f"{MEASURED}{rig}.json")
    lines = []
    for line, model in zip(history(models), models, strict=True):
        last = measured.get(line.model)
        evidence = model.evidence
        inference = evidence.get("inference")
        lines.append(
            {
                "model": line.model,
                "parent": line.parent,
                "effects": list(line.effects),
                "error": last["error_over_floor"] if last else line.error_over_floor,
                "rollouts": len(last["rollouts"]) if last else 0,
                "made": evidence.get("kind") or ("inference" if inference else "prior" if line.parent else "built in"),
                "accepted": evidence.get("accepted"),
                "created": model.created,
                "mean": {p.name: (float(v), p.unit) for p, v in zip(model.parameters, model.mean(), strict=True)},
            }
        )
    return lines


def _measured(path: Path) -> dict[str, dict[str, Any]]:
    """The lines of the last measurement, by version; none where it was on no unseen rollout."""
    try:
        lines = json.loads(path.read_text(encoding="utf-8"))["lines"]
    except (OSError, ValueError, KeyError):
        return {}
    return {line["model"]: line for line in lines if line["rollouts"]}


def posterior(store: ModelStore, version: str) -> dict[str, Any]:
    """Draws of a version's parameters, what the data tell of each, and how the inference came to it."""
    model = store.load(version)
    draws = model.sample(np.random.default_rng(0), DRAWS)
    told = {p["name"]: p for p in (model.evidence.get("inference") or {}).get("parameters", [])}
    return {
        "version": version,
        "parameters": [
            {
                "name": p.name,
                "unit": p.unit,
                "low": p.low,
                "high": p.high,
                "scale": p.scale,
                "identified": told.get(p.name, {}).get("identified"),
                "mean": float(m),
                "low90": float(np.quantile(column, 0.05)),
                "high90": float(np.quantile(column, 0.95)),
            }
            for p, m, column in zip(model.parameters, model.mean(), draws.T, strict=True)
        ],
        "draws": draws.tolist(),
        "generations": generations(store.models / version / "posterior.nc"),
    }


def generations(path: Path) -> dict[str, Any] | None:
    """Mean and standard deviation of each parameter over the generations; None for a version not inferred."""
    import h5py

    if not path.is_file():
        return None
    with h5py.File(path) as file:
        group = file.get("generations")
        if group is None:
            return None
        names = [n.decode() if isinstance(n, bytes) else str(n) for n in group["parameter"][()]]
        mean, variance = group["mean"][()], group["variance"][()]
        return {
            "number": [int(g) for g in group["generation"][()]],
            "mean": {n: mean[:, i].tolist() for i, n in enumerate(names)},
            "sd": {n: np.sqrt(variance[:, i]).tolist() for i, n in enumerate(names)},
            "ess": [float(e) for e in group["ess"][()]],
        }


def difference(store: ModelStore, before: str, after: str) -> dict[str, Any]:
    """Two versions: a sentence, and each parameter with its 90 % interval in both."""
    from tcbi_infer.compare.versions import compare_versions

    d = compare_versions(store.load(before), store.load(after))
    rows = []
    for p in d.parameters:
        row: dict[str, Any] = {"name": p.name, "unit": p.unit, "overlap": p.overlap, "width_ratio": p.width_ratio}
        for key, interval in (("before", p.before), ("after", p.after)):
            row[key] = None if interval is None else [interval.mean, interval.low90, interval.high90]
        rows.append(row)
    return {"statement": d.statement, "parameters": rows}
