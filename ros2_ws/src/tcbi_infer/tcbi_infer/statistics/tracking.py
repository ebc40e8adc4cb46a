"""Joint tracking error: where a joint is, minus where the command's ramp asks it to be."""

import numpy as np

from tcbi_infer.statistics.base import RolloutArrays, Statistic


def tracking_error(arrays: RolloutArrays) -> np.ndarray:
    """(N, S, J, T) rad; NaN before the first command."""
    return np.swapaxes(arrays.joint_position - arrays.reference, -1, -2)


STATISTIC = Statistic(
    name="joint_tracking",
    unit="rad",
    description="joint position minus commanded ramp, per joint",
    needs=(),
    channels=lambda arrays: arrays.joint_names,
    compute=tracking_error,
)
