"""Are the rollouts of one robot? Two robots' rollouts taken together look like one robot in the middle, or like none.

Each rollout alone says which parameters would move most like it (`predictive`). Of one robot these values scatter about
one place; of two they lie about two, with a gap between.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from tcbi_contract.wording import counted, some, with_unit
from tcbi_sim.parameter import Parameter

LEAST_ROLLOUTS = 6  # of which fewer fall into two groups by chance
LEAST_GROUP = 2  # rollouts: a single one that is unlike the others is told as such
LEAST_APART = 0.05  # of a range, between the groups' means
LEVEL = 0.001  # of chance, shared among the parameters
DRAWS = 4000  # of values about one place, of which few lie beyond that level


class Groups(NamedTuple):
    """The two groups of rollouts that one parameter's values fall into."""

    parameter: int
    low: tuple[int, ...]  # rollouts, by their number
    high: tuple[int, ...]


def groups(values: np.ndarray) -> Groups | None:
    """Two groups of rollouts that lie further apart than values about one place ever seem to.

    For each parameter the best of all cuts through the sorted values, by the distance of both sides' means over the
    spread within them, against the same of normal draws (Engelman and Hartigan, Percentage points of a test for
    clusters, 1969).

    Args:
      values: (R, P) of each rollout, in shares of the parameters' ranges.

    Returns:
      None where there are none, or too few rollouts to tell.
    """
    values = np.asarray(values, float)
    if len(values) < LEAST_ROLLOUTS or not np.isfinite(values).all():
        return None
    count, width = values.shape
    chance = _gaps(np.sort(np.random.default_rng(0).standard_normal((DRAWS, count)), axis=1)).max(axis=1)
    least = np.quantile(chance, 1.0 - LEVEL / width)
    found: list[tuple[float, Groups]] = []
    for p in range(width):
        order = np.argsort(values[:, p], kind="stable")
        gaps = _gaps(values[order, p][None])[0]
        cut = int(np.argmax(gaps)) + LEAST_GROUP
        low, high = order[:cut], order[cut:]
        if gaps.max() > least and values[high, p].mean() - values[low, p].mean() > LEAST_APART:
            found.append((gaps.max(), Groups(p, tuple(sorted(low.tolist())), tuple(sorted(high.tolist())))))
    return max(found)[1] if found else None


def mixed(parameters: Sequence[Parameter], values: Sequence[Sequence[float]], rollouts: Sequence[str]) -> list[str]:
    """A line where the rollouts seem to be of two robots, or of one that changed.

    Args:
      parameters: P.
      values: (R, P) that move most like each rollout, in shares of the parameters' ranges; empty where not known.
      rollouts: R ids.
    """
    found = groups(np.reshape(values, (-1, len(parameters))))
    if found is None:
        return []
    p, each = parameters[found.parameter], np.asarray(values)[:, found.parameter]

    def like(group: Sequence[int]) -> str:
        middle = float(p.from_unit(np.clip(np.median(each[list(group)]), 0.0, 1.0)))
        return with_unit(f"{middle:.3g}", p.unit)

    few, others = sorted((found.low, found.high), key=lambda group: (len(group), group))
    return [
        f"the rollouts seem to be of two robots, or of one that changed: {some([rollouts[r] for r in few])} move most "
        f"like {p.name} {like(few)}, the other {counted(len(others), 'rollout')} like {like(others)}, and none lies "
        "between; infer them apart (a missing effect may look so where rollouts show two kinds of motion)"
    ]


def _gaps(values: np.ndarray) -> np.ndarray:
    """(N, cuts) distance of the means of both sides over the spread within them, of (N, R) sorted values."""
    count = values.shape[1]
    cuts = np.arange(LEAST_GROUP, count - LEAST_GROUP + 1)
    total, squares = np.cumsum(values, axis=1), np.cumsum(values**2, axis=1)
    below, above = total[:, cuts - 1] / cuts, (total[:, -1:] - total[:, cuts - 1]) / (count - cuts)
    within = squares[:, -1:] - cuts * below**2 - (count - cuts) * above**2
    spread = np.sqrt(np.maximum(within, 0.0) / (count - 2))
    return (above - below) / np.maximum(spread, 1e-9)
