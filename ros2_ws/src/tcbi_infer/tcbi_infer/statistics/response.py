"""Early response: the share of a commanded step that a joint has made 60 ms after the command.

Gain, load and delays show here before contacts mix everything; steps below `MIN_STEP` are left out, since there the
share is mostly noise.
"""

import numpy as np

from tcbi_infer.statistics.base import RolloutArrays, Statistic

DELAY_S = 0.06
MIN_STEP = 0.03  # rad


def early_response(arrays: RolloutArrays) -> np.ndarray:
    """(N, S, J, K) share of each step made after DELAY_S; NaN for small steps and the first command."""
    before = arrays.at(arrays.joint_position, arrays.command_time)
    after = arrays.at(arrays.joint_position, arrays.command_time + DELAY_S)
    step = np.full_like(arrays.command_target, np.nan)
    step[:, :, 1:] = np.diff(arrays.command_target, axis=2)
    large = np.abs(step) >= MIN_STEP
    share = np.where(large, (after - before) / np.where(large, step, 1.0), np.nan)
    return np.swapaxes(share, -1, -2)


def lacks(arrays: RolloutArrays) -> str:
    """Without steps of some size there is no response to see."""
    step = np.abs(np.diff(arrays.command_target, axis=2))
    return "" if step.size and np.any(step >= MIN_STEP) else f"no commanded step of at least {MIN_STEP} rad"


STATISTIC = Statistic(
    name="early_response",
    unit="1",
    description=f"share of a commanded step made after {DELAY_S * 1000:.0f} ms, per joint",
    needs=(),
    channels=lambda arrays: arrays.joint_names,
    compute=early_response,
    lacks=lacks,
)
