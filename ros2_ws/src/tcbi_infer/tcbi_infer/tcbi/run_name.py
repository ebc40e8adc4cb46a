"""A name for an inference, from all that its bits hang on: one that was stopped goes on under the same name only."""

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from tcbi_infer.tcbi.problem import Problem
from tcbi_sim.ray_workers import versions


def run_name(problem: Problem, method: str, settings: Any, seed: int) -> str:
    """A name for an inference: the same for the same rollouts, model, method, settings, seed and versions."""
    what = {
        "model": problem.model.version,
        "effects": problem.model.effects,
        "joint_gains": problem.model.joint_gains,
        "fixed": problem.model.fixed,
        "priors": [(p.low, p.high, p.scale) for p in problem.model.parameters],
        "rollouts": [_digest(m) for g in problem.groups for m in g.measurements],
        "versions": versions(),
        "statistics": problem.observed.channels,
        "closed": [controller is not None for controller in problem.controllers],
        "timestep": [problem.timestep, problem.short_step],
        "divergence": problem.divergence_name,
        "bins": [b.bins for b in problem.binnings[:1]],
        "prior": None if problem.prior is None else problem.prior.means.tolist(),
        "method": method,
        "settings": list(settings),
        "seed": seed,
    }
    digest = hashlib.sha256(json.dumps(what, sort_keys=True).encode()).hexdigest()
    return f"infer-{method}-{digest[:12]}"


def _digest(value: Any) -> str:
    """Of all that a measurement holds, its arrays to the last bit."""
    if isinstance(value, np.ndarray):
        told = f"{value.dtype}{value.shape}".encode() + value.tobytes()
    elif dataclasses.is_dataclass(value):
        told = "".join(_digest(getattr(value, field.name)) for field in dataclasses.fields(value)).encode()
    elif isinstance(value, Mapping):
        told = "".join(_digest((key, *value[key])) for key in sorted(value)).encode()
    elif isinstance(value, tuple):
        told = "".join(map(_digest, value)).encode()
    else:
        told = repr(value).encode()
    return hashlib.sha256(told).hexdigest()
