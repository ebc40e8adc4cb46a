"""Contact-time ratio: the share of time that a foot is on the ground (one of the paper's three statistics).

One ratio a rollout and foot would leave 20 samples for 20 bins, whose divergence is mostly noise (its expectation under
equal distributions is (bins - 1) / (4 x samples) = 0.24 of at most 0.69); the ratio is taken in windows of two seconds.
"""

import numpy as np

from tcbi_infer.statistics.base import RolloutArrays, Statistic

WINDOW_S = 2.0


def contact_ratio(arrays: RolloutArrays) -> np.ndarray:
    """(N, S, F, K) share of each window in contact; a rollout shorter than a window is one window."""
    assert arrays.contact is not None
    windows = max(1, int((arrays.time[-1] - arrays.time[0] + 1e-9) / WINDOW_S))
    parts = np.array_split(arrays.contact, windows, axis=2)
    return np.stack([part.mean(axis=2) for part in parts], axis=-1)


STATISTIC = Statistic(
    name="contact_ratio",
    unit="1",
    description=f"share of time that each foot is on the ground, in windows of {WINDOW_S:g} s",
    needs=("contact",),
    channels=lambda arrays: arrays.foot_names,
    compute=contact_ratio,
)
