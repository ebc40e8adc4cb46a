"""What an earlier life of the inference node left: the version to go on from, and the posterior that it published."""

from typing import Any

import numpy as np

from tcbi_infer.inference_worker import DRAWS
from tcbi_sim.model import Model
from tcbi_sim.store import ModelStore


def newest_fit(store: ModelStore, start: Model, method: str) -> Model | None:
    """The newest version that this method fitted, of `start` and those that come from it with the same effects."""
    line = {start.version: start}
    for version in store.history(start.rig):
        if version.parent in line and version.effects == start.effects:
            line[version.version] = version
    fits = [version for version in line.values() if version.evidence.get("inference", {}).get("method") == method]
    return fits[-1] if fits else None


def posterior_of(store: ModelStore, version: Model) -> dict[str, Any]:
    """What `tcbi_msgs/Posterior` holds of a version that was inferred, from its files.

    Raises:
      OSError, KeyError: they were not written whole.
    """
    import xarray as xr  # loaded by now, since the version was

    path = store.models / version.version / "posterior.nc"
    inference = version.evidence["inference"]
    rows = {row["name"]: row for row in inference["parameters"]}
    with xr.open_dataset(path, group="prior", engine="h5netcdf") as prior:
        prior_variance = [float(prior[name].var()) for name in version.names]
    with xr.open_dataset(path, group="generations", engine="h5netcdf") as generations:
        divergence = generations["divergence"].values[-1].tolist()
        count = generations.sizes["generation"]
    return {
        "rig": version.rig,
        "model": version.version,
        "task": inference["task"],
        "method": inference["method"],
        "generation": count,
        "parameter": list(version.names),
        "unit": [p.unit for p in version.parameters],
        "mean": [rows[name]["mean"] for name in version.names],
        "variance": [rows[name]["sd"] ** 2 for name in version.names],
        "prior_variance": prior_variance,
        "identified": [rows[name]["identified"] for name in version.names],
        "particles": version.sample(np.random.default_rng(0), DRAWS).ravel().tolist(),
        "weights": [1.0 / DRAWS] * DRAWS,
        "effective_sample_size": inference["ess"],
        "statistic": inference["statistics"],
        "divergence": divergence,
        "source_rollouts": inference["rollouts"],
        "converged": inference["converged"],
    }
