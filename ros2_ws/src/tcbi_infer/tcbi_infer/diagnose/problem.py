"""The data of a diagnosis as one weighted, robust regression problem.

A rollout's residuals are scaled by the noise floor and by one scale for each kind of signal, which every model
estimates for itself: a model that leaves errors twice the floor must say so, and pays for it in held-out score.
Heavy tails (a slipped foot) are Student-t. Neighbouring samples are not independent: each kind of signal counts for
as many samples as its autocorrelation leaves.
"""

import dataclasses

import numpy as np

from tcbi_infer.compare.noise import autocorrelation_time
from tcbi_infer.compare.replay import Replay

ALL = slice(None)
TAIL = 4.0  # degrees of freedom of the Student-t loss


@dataclasses.dataclass(frozen=True)
class Problem:
    """What is to be explained: S replicate sets, T samples, C channels, G kinds of signal.

    Attributes:
      observed: (S, T, C) mean over the replicates of each set, NaN where missing.
      weight: (S, T, C) 1 where a sample counts, else 0.
      floor: (C,) noise floor.
      group: (C,) number of the kind of signal.
      share: (G,) independent samples per sample.
      kind: (S,) number of the kind of motion.
    """

    replay: Replay
    observed: np.ndarray
    weight: np.ndarray
    floor: np.ndarray
    group: np.ndarray
    share: np.ndarray
    kind: np.ndarray

    @staticmethod
    def of(replay: Replay, floor: np.ndarray) -> "Problem":
        """The problem before anything is known of its autocorrelation."""
        observed = replay.means()
        names = list(dict.fromkeys(c.group.name for c in replay.layout.channels))
        group = np.array([names.index(c.group.name) for c in replay.layout.channels])
        fitted = np.array([c.group.fitted for c in replay.layout.channels])
        weight = (replay.layout.kept(observed.shape[1]) & fitted & np.isfinite(observed)).astype(float)
        kind = np.array([g.kind for g in replay.replicates])
        return Problem(replay, observed, weight, floor, group, np.full(len(names), 0.1), kind)

    def with_autocorrelation(self, residual: np.ndarray) -> "Problem":
        """The same problem, each kind of signal counting for its independent samples.

        Args:
          residual: (S, T, C) of a fitted model.
        """
        share = []
        for g in range(len(self.share)):
            channels = self.group == g
            step = self.replay.layout.samples_in(self.replay.layout.channels[int(np.argmax(channels))].group)
            scaled = (residual * np.where(self.weight > 0, 1.0, np.nan))[:, step // 2 :: step][..., channels]
            share.append(1.0 / autocorrelation_time(scaled / self.floor[channels]))
        return dataclasses.replace(self, share=np.array(share))

    def residual(self, predicted: np.ndarray, sets: np.ndarray | slice = ALL) -> np.ndarray:
        """(..., S, T, C) observed less predicted; what does not count is 0, what diverged stays NaN."""
        return np.where(self.weight[sets] > 0, self.observed[sets] - predicted, 0.0)

    def scales(self, residual: np.ndarray, sets: np.ndarray) -> np.ndarray:
        """(G,) by how much the errors of each kind of signal exceed the floor, robustly; at least 1.

        Args:
          residual: (S, T, C).
          sets: indices of the sets to look at.
        """
        scaled = (residual[sets] / self.floor) ** 2
        result = np.ones(len(self.share))
        for g in range(len(result)):
            channels = self.group == g
            weight, squares = self.weight[sets][..., channels], scaled[..., channels]
            if not weight.sum():
                continue
            scale2 = float((weight * squares).sum() / weight.sum())
            for _ in range(15):  # fixed point of the Student-t scale equation
                tail = (TAIL + 1.0) / (TAIL + squares / max(scale2, 1e-12))
                scale2 = float((weight * tail * squares).sum() / weight.sum())
            result[g] = max(1.0, np.sqrt(scale2))
        return result

    def loss(self, residual: np.ndarray, scale: np.ndarray, sets: np.ndarray | slice = ALL) -> np.ndarray:
        """(..., S) negative log score of each set, in nats of independent samples; infinite where diverged.

        Args:
          residual: (..., S, T, C), of these sets.
          scale: (G,).
          sets: indices of the sets.
        """
        sigma = self.floor * scale[self.group]
        cost = (TAIL + 1.0) / 2.0 * np.log1p((residual / sigma) ** 2 / TAIL) + np.log(scale)[self.group]
        total = (cost * self.weight[sets] * self.share[self.group]).sum(axis=(-2, -1))
        return np.where(np.isfinite(total), total, np.inf)

    def precision(self, residual: np.ndarray, scale: np.ndarray) -> np.ndarray:
        """(S, T, C) weight of each squared residual in the quadratic that touches the loss at `residual`."""
        sigma = self.floor * scale[self.group]
        tail = (TAIL + 1.0) / (TAIL + (residual / sigma) ** 2)
        return self.weight * self.share[self.group] * tail / sigma**2
