"""How fine a replay must be simulated, so that its time step is no error of the model.

A semi-implicit step leaves a joint about half a step late or early. Where a rig moves fast and hardly differs from
itself (a servo bench), that is more than the noise floor, and a diagnosis would take it for a latency.
"""

import numpy as np

from tcbi_infer.compare.replay import Replay
from tcbi_infer.compare.signals import JOINT
from tcbi_sim.model import Model

USUAL_STEP, LEAST_STEP = 0.002, 0.0005  # s
MATTERS = 0.5  # of the noise floor: what a halved step may change of a joint, in the median of joints and motions


def fine_step(
    replay: Replay,
    model: Model,
    floor: np.ndarray,
    sets: list[int] | None = None,
    parameters: np.ndarray | None = None,
) -> float:
    """The largest time step (s) that halving does not change by much: the usual one, or a half or a quarter of it.

    The median counts: where feet stick and slip, single motions part at any step.

    Args:
      replay: what is simulated.
      model: its structure.
      floor: (C,) of each channel.
      sets: of replicates; all by default.
      parameters: (P,) to simulate with; the model's mean by default.
    """
    step, joints = USUAL_STEP, replay.layout.where(JOINT)
    values = (model.mean() if parameters is None else parameters)[None]
    now = replay.predict(model, values, sets, step)[0]
    while step > LEAST_STEP:
        finer = replay.predict(model, values, sets, step / 2)[0]
        change = ((now - finer)[..., joints] / floor[joints]) ** 2
        each = np.sqrt(change.mean(axis=1))  # of a set and a joint
        if _middle(each) <= MATTERS:
            break
        step, now = step / 2, finer
    return step


def _middle(values: np.ndarray) -> float:
    """Their median, of those that are finite; 0 without any."""
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) else 0.0
