"""What the Add view tells of the store's versions: read in a thread, since its libraries take a second to load."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tcbi_dashboard.error_line import ErrorLine, error_line, made_before
from tcbi_dashboard.names import MEASURED
from tcbi_sim.model import Model
from tcbi_sim.store import ModelStore

DRAWS = 300
TECHNICAL = "with fewer than", "the same in every sample", "open loop", "closed loop", "resumed"  # notes that few need
MADE = {
    **{"diagnosis": "fitted", "inference": "inferred", "remove": "effect taken out", "prior": "nothing fitted"},
    "fix": "values fixed or freed",
}


def errors(store: ModelStore, rig: str) -> tuple[ErrorLine, dict[str, tuple[tuple[str, ...], str]]]:
    """The errors of a rig's versions from one source, and of each version its effects and how it was made."""
    models = store.history(rig)
    line = error_line(models, _measured(store.root / "runs" / f"{MEASURED}{rig}.json"))
    return line, {m.version: (m.effects, _made(m)) for m in models}


def _made(model: Model) -> str:
    from tcbi_infer.diagnose.adopt import doubt

    kind = model.made_by
    parent = f" from v{model.parent.rpartition('-v')[2]}" if model.parent else ""
    guess = ", a guess" if kind == "diagnosis" and model.evidence.get("use") and doubt(model.evidence) else ""
    return f"{MADE.get(kind, kind)}{parent}{guess}"


def _measured(path: Path) -> dict[str, Any] | None:
    """The last measurement of all versions; None without one."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        return found if {"lines", "given"} <= set(found) else None
    except (OSError, ValueError, TypeError):
        return None


def already(store: ModelStore, diagnosis: Mapping[str, Any], use: str) -> tuple[list[str], list[str]]:
    """Versions that have this effect added already: from this diagnosis, and from others of the same version."""
    rig = diagnosis["model"].rpartition("-v")[0]
    return made_before(store.history(rig), diagnosis, use)


def posterior(store: ModelStore, version: str) -> dict[str, Any]:
    """A version's parameters, what the data tell of each, draws of them, and how an inference came to it."""
    from tcbi_infer.compare.versions import intervals

    model = store.load(version)
    tells = _tells(store, model)
    known = intervals(model)
    inference = model.evidence.get("inference") or {}
    warnings = inference.get("warnings", [])
    return {
        "version": version,
        "origin": origin(model),
        "notes": [w for w in warnings if not w.startswith(TECHNICAL)],
        "technical": [w for w in warnings if w.startswith(TECHNICAL)],
        "parameters": [
            {
                "name": p.name,
                "unit": p.unit,
                "low": p.low,
                "high": p.high,
                "scale": p.scale,
                "tells": tells.get(p.name, "its prior"),
                "mean": known[p.name].mean,
                "low90": known[p.name].low90,
                "high90": known[p.name].high90,
            }
            for p in model.parameters
        ],
        "draws": model.sample(np.random.default_rng(0), DRAWS).tolist(),
        "generations": generations(store, model),
    }


def origin(model: Model) -> str:
    """What a version's distribution rests on, in a sentence or two; names the prior, and what is fixed."""
    fixed = f" Fixed at what was measured otherwise: {model.fixed_told}." if model.fixed else ""
    return _origin(model) + fixed


def _origin(model: Model) -> str:
    e, kind = model.evidence, model.made_by
    if kind == "inference":
        i = e["inference"]
        prior = i.get("prior", model.parent)  # versions of before do not say: the page and the demo went on from there
        before = "flat over each parameter's range" if prior == "flat" else f"what {prior} says"
        fits = i.get("fits", not any(w.startswith("no parameters reproduce") for w in i["warnings"]))
        why = "the search was too short to tell whether the model fits" if fits is None else "the model fits poorly"
        poorly = "" if fits else f" No parameter counts as identified, since {why}."
        return (
            f"Inferred from {_count(i['rollouts'])} by the method {i['method']}, with {i['ess']:.0f} effective "
            f"particles; its prior is {before}.{poorly}"
        )
    if kind == "diagnosis":
        beside = f"with {e['use']}" if e.get("use") else "without a new effect"
        return (
            f"Fitted {beside} by a diagnosis of {model.parent}, to {_count(e.get('rollouts', ()))}. Its intervals are "
            "those of a fit, which are too narrow (docs/diagnosis.md)."
        )
    if kind == "remove":
        return e["statement"]
    if e.get("kept"):
        return f"Kept from {model.parent}: nothing was fitted anew."
    return "Nothing was fitted: this is the prior."


def _tells(store: ModelStore, model: Model) -> dict[str, str]:
    """For each parameter what the data tell of it, beside what was known before; nothing where nothing was fitted."""
    from tcbi_infer.compare.versions import compare_versions

    kind = model.made_by
    if kind == "inference":
        return {p["name"]: _verdict(p) for p in model.evidence["inference"]["parameters"]}
    if model.parent not in store.versions(model.rig):
        return {}
    parent = store.load(model.parent or "")
    if kind == "remove":
        return {name: f"kept from {parent.version}" for name in model.names}
    if kind != "diagnosis":
        return {name: f"kept from {parent.version}" for name in parent.names}
    changes = {c.name: c for c in compare_versions(parent, model).parameters}
    return {
        name: f"fitted; interval {changes[name].width_ratio:.0%} as wide as in {parent.version}"
        if changes[name].width_ratio is not None
        else "fitted, new here"
        for name in model.names
    }


def _verdict(p: Mapping[str, Any]) -> str:
    """Of one inferred parameter; the variances are on the parameter's own scale."""
    variance = f"variance {p['variance_ratio']:.0%} of its prior's"
    if p["identified"]:
        return f"yes: {variance}"
    return f"not surely: {variance}" if p["variance_ratio"] < 0.5 else f"little: {variance}"


def _count(rollouts: Any) -> str:
    return f"{len(rollouts)} rollout{'s' * (len(rollouts) != 1)}"


def generations(store: ModelStore, model: Model) -> dict[str, Any] | None:
    """Mean and standard deviation of each parameter over the generations; None for a version not inferred."""
    if model.made_by != "inference":
        return None
    return _saved_generations(store.models / model.version / "posterior.nc") or _run_generations(store, model)


def _saved_generations(path: Path) -> dict[str, Any] | None:
    import h5py

    if not path.is_file():
        return None
    with h5py.File(path) as file:
        group = file.get("generations")
        if group is None:
            return None
        names = [n.decode() if isinstance(n, bytes) else str(n) for n in group["parameter"][()]]
        number = [int(g) for g in group["generation"][()]]
        return _over_generations(number, names, group["mean"][()], group["variance"][()])


def _run_generations(store: ModelStore, model: Model) -> dict[str, Any] | None:
    """From the run that ended with this version's means: versions of before do not hold their generations."""
    found = model.evidence["inference"]
    names, means = [p["name"] for p in found["parameters"]], [p["mean"] for p in found["parameters"]]
    for path in sorted(store.root.glob(f"runs/infer-{found['method']}-*/generations.json")):
        try:
            rows = json.loads(path.read_text(encoding="utf-8"))
            if np.shape(rows[-1]["mean"]) == np.shape(means) and np.allclose(rows[-1]["mean"], means, rtol=1e-9):
                mean, variance = (np.array([r[key] for r in rows]) for key in ("mean", "variance"))
                return _over_generations([r["generation"] for r in rows], names, mean, variance)
        except (OSError, ValueError, KeyError, IndexError, TypeError):
            continue
    return None


def _over_generations(number: list[int], names: list[str], mean: np.ndarray, variance: np.ndarray) -> dict[str, Any]:
    return {
        "number": number,
        "mean": {n: mean[:, i].tolist() for i, n in enumerate(names)},
        "sd": {n: np.sqrt(variance[:, i]).tolist() for i, n in enumerate(names)},
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
