"""Effects by which commands get lost at random.

A replay loses other commands than the robot did, so that no fit can size them. What the robot's repeats differ in does.
"""

from collections.abc import Sequence

import numpy as np

from tcbi_infer.compare.replay import Replay
from tcbi_infer.compare.steadiness import Lost, unfollowed
from tcbi_infer.diagnose.evidence import Evidence
from tcbi_infer.diagnose.judge import estimate
from tcbi_sim.engine import Simulator
from tcbi_sim.measurement import Scenario
from tcbi_sim.model import Model
from tcbi_sim.parameter import Parameter

AT_RANDOM = "a replay loses other commands than the robot did"


def at_random(model: Model, use: str) -> bool:
    """Whether commands get lost by an effect that reach the model without it: which ones no two robots share."""
    child = model.with_effect(use)
    return _loss(child, child.mean()) > _loss(model, model.mean())


def suspected(model: Model, replay: Replay, uses: Sequence[str], error_before: float) -> list[Evidence]:
    """Of uses at random those whose size a robot's repeats tell, where it follows commands once and once not.

    Args:
      model: that is diagnosed.
      replay: of the robot's recordings.
      uses: at random.
      error_before: of the base model over the noise floor.
    """
    lost = unfollowed(replay)
    shares = [(use, _share(model, use)) for use in uses] if lost else []
    return [_evidence(use, share, lost, error_before) for use, share in shares if lost and share]


def _evidence(use: str, parameter: Parameter, lost: Lost, error_before: float) -> Evidence:
    ends = (float(parameter.to_unit(np.clip(share, parameter.low, parameter.high))) for share in lost)
    return Evidence(
        effect=use.partition(":")[0],
        use=use,
        elpd_gain=float("nan"),
        elpd_se=float("nan"),
        statistic=float("nan"),
        error_before=error_before,
        error_after=float("nan"),
        parameters=(estimate(parameter, *ends),),
        refined=False,
        converged=False,
        reason=f"its size is told by what repeats differ in; {AT_RANDOM}",
    )


def _share(model: Model, use: str) -> Parameter | None:
    """An effect's parameter, if it has only this one and it is the share of commands that are lost."""
    child = model.with_effect(use)
    own = child.parameters[len(model.parameters) :]
    if len(own) != 1 or _loss(model, model.mean()):
        return None
    middle = (own[0].low + own[0].high) / 2
    return own[0] if np.isclose(_loss(child, np.append(model.mean(), middle)), middle) else None


def _loss(model: Model, values: np.ndarray) -> float:
    start = [Scenario("none", 1.0, settle=0.0)]
    return float(Simulator(model, values[None], start, threads=1).fields.command.loss[0])
