"""Divergences of pooled histograms: what `calibrated` weighs by, for any subset or resample of the rollouts.

    measure = pooled_divergence("wasserstein", binnings, counts)
    measure(real, simulated)                    # (R, C, B) and (M, R, C, B) counts -> (M, R, C)
    noise, freedom = measure.noise(real, simulated)         # (U, C, B) counts each -> (C,), (C,)

`js`, `wasserstein` and `mmd` are computed from the counts. Any other divergence, the user's own among them, is one of
samples: each histogram stands for `POINTS` samples, evenly spaced in its cumulative distribution.
"""

import abc
import functools
from collections.abc import Sequence
from typing import Protocol

import numpy as np

from tcbi_infer.divergence import Binning, js_binned, measured, normalised

JS = "js"
POINTS = 60  # samples that a histogram stands for
DRAWS = 32  # of the residuals' signs, and of independent samples


class PooledDivergence(Protocol):
    """A divergence of counts, and what remains of it where nothing is wrong."""

    @property
    def particles(self) -> int:
        """How many of them have their resamples judged: what takes some seconds."""

    def __call__(self, real: np.ndarray, simulated: np.ndarray) -> np.ndarray:
        """(..., C, B) and (M, ..., C, B) counts -> (M, ..., C)."""

    def noise(self, real: np.ndarray, simulated: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Expected (C,) if the residuals of (U, C, B) counts had mean zero, and its degrees of freedom (C,)."""


class JensenShannon:
    """Equation 13 on histograms, in closed form."""

    particles = 300

    def __call__(self, real: np.ndarray, simulated: np.ndarray) -> np.ndarray:
        """(..., C, B) and (M, ..., C, B) counts -> (M, ..., C) nats."""
        return js_binned(real, simulated)

    def noise(self, real: np.ndarray, simulated: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Expected (C,) by its expansion for small differences; degrees of freedom are the bins in use."""
        middle, moved = _residuals(real, simulated)
        variance = np.sum(moved**2, axis=0)
        freedom = effective_bins(real)
        least = freedom / (8 * np.maximum(real.sum(axis=(0, 2)), 1))  # were all samples independent
        expected = np.sum(variance / np.where(middle > 0, 8.0 * middle, np.inf), axis=-1)
        return np.maximum(expected, least), freedom


class _Signed(abc.ABC):
    """A divergence whose noise floor has no closed form: it is the mean over residuals with random signs."""

    particles = 300

    def __init__(self, counts: np.ndarray):
        """Of the real rollouts' (U, C, B) counts."""
        self._pooled = counts.sum(axis=0)

    @abc.abstractmethod
    def __call__(self, real: np.ndarray, simulated: np.ndarray) -> np.ndarray:
        """(..., C, B) and (M, ..., C, B) counts -> (M, ..., C)."""

    def noise(self, real: np.ndarray, simulated: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Expected (C,), no less than of independent samples, and its degrees of freedom (C,) by its variance."""
        middle, moved = _residuals(real, simulated)
        signs = np.random.default_rng(0).choice([-0.5, 0.5], (DRAWS, len(moved)))
        apart = np.tensordot(signs, moved, axes=1)
        drawn = self(np.maximum(middle + apart, 0.0), np.maximum(middle - apart, 0.0)[None])[0]
        mean, variance = drawn.mean(axis=0), drawn.var(axis=0, ddof=1)
        freedom = 2 * mean**2 / np.where(variance > 0, variance, np.inf)
        return np.maximum(mean, self._least), np.clip(freedom, 1.0, effective_bins(real))

    @functools.cached_property
    def _least(self) -> np.ndarray:
        """Mean (C,) of the divergence of as many independent samples from what they are drawn from.

        That is the real histogram and one more sample, spread over all bins: a channel that never changes might have.
        """
        count = self._pooled.sum(axis=-1).astype(int)
        wider = normalised(self._pooled.astype(float) + 1 / self._pooled.shape[-1])
        drawn = np.random.default_rng(0).multinomial(count, wider, (DRAWS, len(count)))
        return self(wider, drawn).mean(axis=0)


class Wasserstein(_Signed):
    """First Wasserstein distance in shares of the real data's range, a tail being one bin beyond it."""

    def __call__(self, real: np.ndarray, simulated: np.ndarray) -> np.ndarray:
        """(..., C, B) and (M, ..., C, B) counts -> (M, ..., C); 0 where the robot has no sample: it tells nothing."""
        apart = _difference(real, simulated)
        return np.abs(np.cumsum(apart, axis=-1)).sum(axis=-1) / (apart.shape[-1] - 2)


class MaximumMeanDiscrepancy(_Signed):
    """Squared maximum mean discrepancy under a Gaussian kernel, between 0 and 2.

    The kernel is as wide as the median distance between the real samples, and at least one bin.
    """

    def __init__(self, counts: np.ndarray):
        """Take the kernels' widths from the real rollouts' (U, C, B) counts."""
        super().__init__(counts)
        bins = np.arange(counts.shape[-1])
        between = np.abs(bins[:, None] - bins)
        shares = normalised(self._pooled)
        pairs = shares[:, :, None] * shares[:, None, :]
        within = np.stack([(pairs * (between <= d)).sum(axis=(1, 2)) for d in bins], axis=-1)
        width = np.maximum((within < 0.5 * pairs.sum(axis=(1, 2))[:, None]).sum(axis=-1), 1)
        self._kernels = np.exp(-0.5 * (between / width[:, None, None]) ** 2)  # (C, B, B)

    def __call__(self, real: np.ndarray, simulated: np.ndarray) -> np.ndarray:
        """(..., C, B) and (M, ..., C, B) counts -> (M, ..., C); 0 where the robot has no sample: it tells nothing."""
        apart = _difference(real, simulated)
        found = np.einsum(
            "...cb,...cb->...c", np.einsum("...cb,cbd->...cd", apart, self._kernels, optimize=True), apart
        )
        return np.maximum(found, 0.0)


class OfSamples(_Signed):
    """A divergence of samples, on histograms."""

    particles = 60

    def __init__(self, name: str, binnings: Sequence[Binning], counts: np.ndarray):
        """By name; C bins, and the real rollouts' (U, C, B) counts in them."""
        super().__init__(counts)
        self._name, self._binnings = name, tuple(binnings)

    def __call__(self, real: np.ndarray, simulated: np.ndarray) -> np.ndarray:
        """(..., C, B) and (M, ..., C, B) counts -> (M, ..., C); 0 where the robot has no sample: it tells nothing."""
        lead, (count, channels, bins) = real.shape[:-2], (len(simulated), *real.shape[-2:])
        rows = real.reshape(-1, channels, bins)
        others = simulated.reshape(count, -1, channels, bins)
        found = np.zeros((count, len(rows), channels))
        for r, c in np.argwhere(rows.sum(axis=-1) > 0):
            binning = self._binnings[c]
            found[:, r, c] = measured(self._name, stand_ins(rows[r, c], binning), stand_ins(others[:, r, c], binning))
        return found.reshape(count, *lead, channels)


def pooled_divergence(name: str, binnings: Sequence[Binning], counts: np.ndarray) -> PooledDivergence:
    """The divergence of that name, for histograms in these bins; (U, C, B) counts are the real rollouts'."""
    if name == JS:
        return JensenShannon()
    if name == "wasserstein":
        return Wasserstein(counts)
    return MaximumMeanDiscrepancy(counts) if name == "mmd" else OfSamples(name, binnings, counts)


def _difference(real: np.ndarray, simulated: np.ndarray) -> np.ndarray:
    """(M, ..., C, B) shares of the real counts less the simulated ones'; 0 where the robot has none.

    A simulation without any sample is as far off as can be: all of it lies in the tail that is further.
    """
    p, q = normalised(real), normalised(simulated)
    middle = np.sum(p * np.arange(p.shape[-1]), axis=-1, keepdims=True)
    far = np.where(middle < (p.shape[-1] - 1) / 2, np.eye(p.shape[-1])[-1], np.eye(p.shape[-1])[0])
    q = np.where(q.sum(axis=-1, keepdims=True) > 0, q, far)
    return np.where(p.sum(axis=-1, keepdims=True) > 0, p - q, 0.0)


def stand_ins(counts: np.ndarray, binning: Binning) -> np.ndarray:
    """(..., B) counts -> (..., POINTS) samples in order of size; NaN where there is no count.

    A bin's samples are spread over it evenly, those of a tail over one bin's width beyond the real data's range.
    """
    flat = normalised(np.asarray(counts, float).reshape(-1, counts.shape[-1]))
    width = (binning.high - binning.low) / (binning.bins - 2)
    edges = binning.low + width * np.arange(-1, binning.bins)
    below = np.concatenate([np.zeros((len(flat), 1)), np.cumsum(flat, axis=-1)], axis=-1)
    levels = np.linspace(1e-6, 1 - 1e-6, POINTS)  # from end to end, so that the range is the histogram's
    bins = (below[:, 1:, None] < levels).sum(axis=1).clip(max=binning.bins - 1)
    share = np.take_along_axis(flat, bins, axis=1)
    within = (levels - np.take_along_axis(below, bins, axis=1)) / np.where(share > 0, share, 1.0)
    some = flat.sum(axis=-1, keepdims=True) > 0
    found = np.where(some, edges[bins] + width * within.clip(0.0, 1.0), np.nan)
    return found.reshape(*counts.shape[:-1], POINTS)


def effective_bins(counts: np.ndarray) -> np.ndarray:
    """(C,) degrees of freedom of (U, C, B) counts: the exponential of the pooled histogram's entropy, less one."""
    p = counts.sum(axis=0) / np.maximum(counts.sum(axis=(0, 2)), 1)[:, None]
    entropy = -np.sum(p * np.log(np.where(p > 0, p, 1)), axis=-1)
    return np.maximum(np.exp(entropy) - 1.0, 1.0)


def _residuals(real: np.ndarray, simulated: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The middle (C, B) of both sides' shares, and how far (U, C, B) each unit moves the sides apart.

    A unit weighs by its samples, as it does in the pooled counts; one without samples on both sides tells nothing. The
    moves are as large as their number makes them look: those of few units are enlarged (n / (n - 1) in the square).
    """
    both = (real.sum(axis=-1) > 0) & (simulated.sum(axis=-1) > 0)
    units = both.sum(axis=0)[:, None]
    shares, moved = zip(*(_pooled(np.where(both[..., None], side, 0.0)) for side in (real, simulated)), strict=True)
    return 0.5 * (shares[0] + shares[1]), (moved[0] - moved[1]) * np.sqrt(units / np.maximum(units - 1, 1))


def _pooled(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Shares (C, B) of (U, C, B) counts together, and how far (U, C, B) each unit moves them."""
    total = np.maximum(counts.sum(axis=(0, 2)), 1)[:, None]
    shares = counts.sum(axis=0) / total
    return shares, (counts - counts.sum(axis=-1, keepdims=True) * shares) / total
