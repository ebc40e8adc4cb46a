"""Noise floors where few units have samples: a right model is not called wrong for it."""

import numpy as np
import pytest
from tcbi_cases import seen

from tcbi_infer.divergence import Binning
from tcbi_infer.tcbi.calibration import floors
from tcbi_infer.tcbi.features import Observed, binned, divergences
from tcbi_infer.tcbi.goodness import POOR
from tcbi_infer.tcbi.pooled import JensenShannon
from tcbi_infer.tcbi.rollouts import blocks_for


def misfit_over_noise(rollouts: int, present: int, seed: int, channels: int = 6) -> float:
    """Of a right model, judged by one sample a channel in each of the first `present` rollouts."""
    rng, blocks = np.random.default_rng(seed), blocks_for(rollouts)
    samples = rng.standard_normal((41, rollouts, channels, 1))
    samples[:, present:] = np.nan
    binnings = [Binning.of(samples[0, :present, c]) for c in range(channels)]
    counts = binned(samples, binnings, blocks)
    names = tuple(f"x/{c}" for c in range(channels))
    observed = Observed(counts[0], np.zeros(channels, int), ("x",), names)
    found = floors(observed, seen(counts[1:], divergences(observed, counts[1:])))
    return float(found.misfit.mean() / found.noise.mean())


@pytest.mark.parametrize(("rollouts", "present"), [(2, 2), (3, 3), (4, 4), (6, 6), (20, 4)])
def test_a_right_model_with_samples_in_few_units_fits(rollouts: int, present: int) -> None:
    """About 1.2 for two rollouts, less for more, with a standard deviation of 0.2: a median above in 1 of 1000."""
    ratios = [misfit_over_noise(rollouts, present, seed) for seed in range(5)]
    assert np.median(ratios) < 1.5 < POOR


def residual_noise(real: np.ndarray, simulated: np.ndarray) -> np.ndarray:
    return JensenShannon().noise(real, simulated)[0]


def test_units_without_samples_change_nothing_and_units_with_more_weigh_more() -> None:
    rng = np.random.default_rng(0)
    real, simulated = rng.poisson(4.0, (2, 10, 3, 6)).astype(float)
    noise = residual_noise(real, simulated)
    nothing = np.zeros((15, 3, 6))
    assert np.allclose(residual_noise(np.concatenate([real, nothing]), np.concatenate([simulated, nothing])), noise)
    one_sided = residual_noise(np.concatenate([real, nothing]), np.concatenate([simulated, nothing + 1]))
    assert np.allclose(one_sided, noise)
    thin = np.concatenate([1000 * real, rng.permuted(real, axis=-1)])
    close = residual_noise(thin, np.concatenate([1000 * simulated, simulated]))
    assert np.allclose(close, noise, rtol=0.1)
