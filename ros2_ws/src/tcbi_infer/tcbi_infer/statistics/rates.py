"""Body rates: the angular velocity that the IMU measures."""

import numpy as np

from tcbi_infer.statistics.base import RolloutArrays, Statistic


def body_rates(arrays: RolloutArrays) -> np.ndarray:
    """(N, S, 3, T) rad/s."""
    assert arrays.angular_velocity is not None
    return np.swapaxes(arrays.angular_velocity, -1, -2)


STATISTIC = Statistic(
    name="body_rates",
    unit="rad/s",
    description="angular velocity of the body about its three axes",
    needs=("angular_velocity",),
    channels=lambda arrays: ("x", "y", "z"),
    compute=body_rates,
)
