"""Posteriors as files: netCDF groups that ArviZ opens (`arviz.from_netcdf`), in its 0.x and 1.x versions alike.

posterior       equally weighted draws, (chain, draw) per parameter
particles       the weighted particles themselves: value (particle, parameter), log_weight (particle)
prior           equally weighted draws of the prior that was used, to compare with
generations     means, variances, ESS, alpha and divergences over generations
"""

import json
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tcbi_contract.files import replacement
from tcbi_infer.tcbi.method import find_method
from tcbi_infer.tcbi.result import Result
from tcbi_sim.model import Model
from tcbi_sim.store import ModelStore

if TYPE_CHECKING:
    import xarray as xr  # seconds, which nodes that save nothing yet do not wait for

DRAWS = 1000


def dataset(result: Result) -> "xr.DataTree":
    """The groups of a result."""
    import xarray as xr

    parameters = result.model.parameters
    rng = np.random.default_rng(0)

    def draws(values: np.ndarray) -> "xr.Dataset":
        return xr.Dataset(
            {p.name: (("chain", "draw"), values[None, :, i], {"units": p.unit}) for i, p in enumerate(parameters)},
            coords={"chain": [0], "draw": np.arange(len(values))},
        )

    particles = xr.Dataset(
        {"value": (("particle", "parameter"), result.particles), "log_weight": ("particle", result.log_weights)},
        coords={"parameter": list(result.model.names)},
    )
    unit = rng.random((DRAWS, len(parameters))) if result.prior is None else result.prior[:DRAWS]
    tree = xr.DataTree.from_dict(
        {
            "posterior": draws(result.draws(DRAWS)),
            "prior": draws(result.model.from_unit(unit)),
            "particles": particles,
            "generations": _generations(result),
        }
    )
    tree.attrs.update(
        {
            "method": result.method,
            "rig": result.model.rig,
            "model": result.model.version,
            "task": result.task,
            "rollouts": json.dumps(result.rollouts),
            "ess": result.ess,
            "simulations": result.simulations,
            "converged": int(result.converged),
            "fits": json.dumps(result.fits if find_method(result.method).judges else None),
            "settings": json.dumps(result.settings),
            "warnings": json.dumps(result.warnings),
        }
    )
    return tree


def _generations(result: Result) -> "xr.Dataset":
    import xarray as xr

    rows = result.generations
    names, statistics = list(result.model.names), list(result.statistics)
    return xr.Dataset(
        {
            "mean": (("generation", "parameter"), np.array([r["mean"] for r in rows]).reshape(-1, len(names))),
            "variance": (("generation", "parameter"), np.array([r["variance"] for r in rows]).reshape(-1, len(names))),
            "divergence": (
                ("generation", "statistic"),
                np.array([r["divergence"] for r in rows]).reshape(-1, len(statistics)),
            ),
            "ess": ("generation", np.array([r["ess"] for r in rows], float)),
            "alpha": ("generation", np.array([r["alpha"] for r in rows], float)),
        },
        coords={"generation": [r["generation"] for r in rows], "parameter": names, "statistic": statistics},
    )


def save(store: ModelStore, result: Result) -> Model:
    """Save a result as the next version of its model, with the groups above in its netCDF file.

    Only then the state is removed from which an interrupted inference goes on.
    """
    saved = store.save(result.updated_model())
    write(store.models / saved.version / "posterior.nc", result)
    result.forget_state()
    return saved


def write(path: Path, result: Result) -> None:
    """Write a result, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacement(path) as work:
        dataset(result).to_netcdf(work, engine="h5netcdf")
