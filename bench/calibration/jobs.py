"""One inference of a known truth: which, and what it found."""

import dataclasses
import json
import time
from typing import Any

import numpy as np
from truths import INFERENCES, RIG, recorded

from tcbi_contract.errors import TcbiError
from tcbi_infer.tcbi.driver import infer
from tcbi_infer.tcbi.method import find_method
from tcbi_infer.tcbi.problem import Problem
from tcbi_infer.tcbi.result import Result as Inference
from tcbi_sim.model import base_model
from tcbi_sim.ray_workers import versions

Result = dict[str, Any]
CODE = versions()["tcbi"]  # as this process has it; the files may change while it runs


@dataclasses.dataclass(frozen=True)
class Case:
    """What is run; a result of the same case is not run again."""

    source: str  # model or robot
    task: str
    truth: int
    method: str
    noise: float  # sigma of equation 14, rad
    rollouts: int
    duration: float  # s
    particles: int
    generations: int
    bins: int
    settings: tuple[tuple[str, float], ...]  # of the method's own
    loop: str = ""  # as of ./tcbi infer; empty for the method's own

    def key(self) -> str:
        """Equal for equal cases, and for their JSON."""
        return json.dumps(dataclasses.asdict(self), sort_keys=True)


def run(case: Case, threads: int = 0) -> Result:
    """Record (or take what was just recorded), infer, compare with the truth; where it fails, `failed` says why.

    Args:
      case: which.
      threads: of the inference, 0 for all processors; the result does not depend on it.
    """
    try:
        return {"code": CODE, **_run(case, threads)}
    except TcbiError as e:
        return {"code": CODE, "case": json.loads(case.key()), "cpu_s": 0.0, "failed": str(e)}


def _run(case: Case, threads: int) -> Result:
    values, rollouts = recorded(case.source, case.task, case.truth, case.rollouts, case.duration, case.noise)
    began, cpu = time.perf_counter(), time.process_time()
    method = find_method(case.method)
    problem = Problem.of(
        base_model(RIG),
        rollouts,
        statistics=method.statistics,
        loop=case.loop or method.loop,
        threads=threads,
        seed=INFERENCES + case.truth,
        bins=case.bins,
    )
    budget = {"particles": case.particles, "generations": case.generations} if case.method != "prior" else {}
    result = infer(problem, case.method, seed=INFERENCES + case.truth, **budget, **dict(case.settings))
    return {
        "case": json.loads(case.key()),
        "parameters": judged(result, values),
        "ess": result.ess,
        "simulations": result.simulations,
        "generations": len(result.generations),
        "converged": result.converged,
        "closed_loop": result.closed_loop,
        "warnings": len(result.warnings),
        "says_misfit": any("no parameters reproduce" in line for line in result.warnings),
        "says_untold": result.fits is None,
        "says_outside": any("seems to exclude" in line for line in result.warnings),
        "wall_s": time.perf_counter() - began,
        "cpu_s": time.process_time() - cpu,
    }


def judged(result: Inference, truth: np.ndarray) -> list[dict[str, Any]]:
    """Each parameter's estimate beside the truth; errors and widths also in shares of the prior's range."""
    weights = np.exp(result.log_weights)
    unit = result.model.to_unit(truth)
    mean = weights @ result.unit
    sd = np.sqrt(weights @ (result.unit - mean) ** 2)
    rank = weights @ (result.unit < unit)
    return [
        {
            "name": e.name,
            "truth": float(truth[i]),
            "mean": e.mean,
            "center": float(result.model.from_unit(mean)[i]),  # the mean on the parameter's scale
            "low90": e.low90,
            "high90": e.high90,
            "identified": e.identified,
            "unit_truth": float(unit[i]),
            "unit_error": float(mean[i] - unit[i]),
            "unit_sd": float(sd[i]),
            "rank": float(rank[i]),
        }
        for i, e in enumerate(result.estimates)
    ]
