"""How far two distributions are apart: small functions by name, the user's own among them (docs/tcbi.md).

Every function takes samples, `(n,)` of the real robot and `(N, m)` of N simulations, and returns `(N,)`
values that are zero for equal distributions. NaN marks a sample that was not measured. `js` also exists on histograms
(`js_binned`), which is what the weights are computed from: counts of several rollouts can be added, so that any subset
of rollouts can be judged without going back to the samples.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tcbi_contract.errors import describe
from tcbi_infer import user_files
from tcbi_infer.errors import InferError
from tcbi_sim.errors import UnknownNameError
from tcbi_sim.user_file import told

BINS = 20
LEAST_BINS = 3
OUTER = 0.005  # share of the samples at either end that may not stretch the bins
NARROW = 0.1  # share of the samples' whole range, below which the real ones' range is no measure of distance
TINY = np.float32(1e-30)  # in place of a probability of zero under a logarithm
LOG2 = float(np.log(2.0))  # the largest Jensen-Shannon divergence, in nats

Divergence = Callable[[np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Binning:
    """Equal bins over the real data's range, and one tail bin on either side for what the robot hardly ever did."""

    low: float
    high: float
    bins: int = BINS

    @classmethod
    def of(cls, real: np.ndarray, bins: int = BINS) -> "Binning":
        """Bins shared by the robot and every simulation, from the range of the real samples.

        The range ends where a sample lies further beyond the inner 99 % than these are apart: such outliers fall in the
        tails, and leave the bins to the others.

        Raises:
          InferError: there is no finite sample, or no bin between the tails.
        """
        if bins < LEAST_BINS:
            raise InferError(describe("bins", bins, f"{LEAST_BINS} or more, two of them tails"))
        finite = np.sort(real[np.isfinite(real)])
        if finite.size == 0:
            raise InferError("a statistic has no finite sample in the real rollouts; leave it out")
        low, high = float(finite[0]), float(finite[-1])
        cut = int(np.ceil(OUTER * (finite.size - 1)))  # on either side, at least one
        within = float(finite[-1 - cut] - finite[cut])
        if within > 0:
            low, high = max(low, float(finite[cut]) - within), min(high, float(finite[-1 - cut]) + within)
        margin = 1e-9 * max(abs(low), abs(high), 1e-3)  # a constant statistic still gets bins
        return cls(low - margin, high + margin, bins)

    def index(self, samples: np.ndarray) -> np.ndarray:
        """Bin of each sample; NaN goes to bin `bins`, which `counts` drops."""
        inner = self.bins - 2
        position = np.subtract(samples, self.low, dtype=float)
        with np.errstate(over="ignore"):  # the tails hold whatever lies beyond
            position *= inner / (self.high - self.low)
        position += 1
        np.clip(position, 0, self.bins - 1, out=position)
        position[np.isnan(position)] = self.bins
        return position.astype(np.int64)  # what lies below 1 is the lower tail

    def counts(self, samples: np.ndarray) -> np.ndarray:
        """(..., n) samples -> (..., bins) counts; infinite samples fall in the tails, NaN nowhere."""
        lead = samples.shape[:-1]
        rows = int(np.prod(lead, dtype=np.int64))
        flat = self.index(samples.reshape(rows, samples.shape[-1]))
        offset = np.arange(rows)[:, None] * (self.bins + 1)
        total = np.bincount((flat + offset).ravel(), minlength=rows * (self.bins + 1))
        return total.reshape(*lead, self.bins + 1)[..., :-1]


def _total(values: np.ndarray) -> np.ndarray:
    """(..., B) -> (...), in a fifth of the time of `sum` where B is small."""
    return np.einsum("...b->...", values)


def _entropy(p: np.ndarray) -> np.ndarray:
    return -np.einsum("...b,...b->...", p, np.log(np.maximum(p, TINY)))


def normalised(counts: np.ndarray) -> np.ndarray:
    """(..., B) counts -> probabilities; all zero where there is no count."""
    total = _total(counts)[..., None]
    return counts / np.where(total > 0, total, 1)


def js_binned(real: np.ndarray, simulated: np.ndarray) -> np.ndarray:
    """Jensen-Shannon divergence (equation 13, nats, not its root) of (..., B) counts.

    Where one side has no sample at all the divergence is its largest value, log 2.
    """
    p, q = normalised(real), normalised(simulated)
    empty = (_total(p) == 0) | (_total(q) == 0)
    value = _entropy(0.5 * (p + q)) - 0.5 * (_entropy(p) + _entropy(q))
    return np.where(empty, LOG2, np.maximum(value, 0.0))


def js(real: np.ndarray, simulated: np.ndarray, bins: int = BINS) -> np.ndarray:
    """Jensen-Shannon divergence by a histogram whose bins come from the real data (nats)."""
    binning = Binning.of(real, bins)
    return js_binned(binning.counts(real), binning.counts(simulated))


def js_nearest(real: np.ndarray, simulated: np.ndarray, k: int = 10) -> np.ndarray:
    """Jensen-Shannon divergence by nearest neighbours: the information that a sample holds about its origin.

    Draws as many samples of either side (evenly spaced ones, so nothing is random) and estimates the posterior of the
    origin from the `k` nearest of the pooled samples, and from all that are as near as the last of these. Between 0
    and log 2, without bins, slower than `js`.
    """
    real = np.sort(real[np.isfinite(real)])
    values = np.empty(len(simulated))
    for i, row in enumerate(simulated):
        row = np.sort(row[np.isfinite(row)])
        n = min(len(real), len(row))
        values[i] = _js_nearest_pair(_spread(real, n), _spread(row, n), min(k, n - 1)) if n > 1 else LOG2
    return values


def _spread(values: np.ndarray, n: int) -> np.ndarray:
    return values[np.linspace(0, len(values) - 1, n).round().astype(int)]


def _js_nearest_pair(a: np.ndarray, b: np.ndarray, k: int) -> float:
    pooled = np.concatenate([a, b])
    order = np.argsort(pooled)
    x, own = pooled[order], order >= len(a)  # own: whether a sample is one of b
    radius = _distance_to_nearest(x, k) + 2 * np.spacing(np.abs(x).max())
    low, high = x - radius, x + radius
    near_a, near_b = (np.searchsorted(side, high, "right") - np.searchsorted(side, low) for side in (a, b))
    share = np.clip((near_b - own) / (near_a + near_b - 1), 1e-12, 1 - 1e-12)
    entropy = -np.mean(share * np.log(share) + (1 - share) * np.log(1 - share))
    return float(np.clip(LOG2 - entropy, 0.0, LOG2))


def _distance_to_nearest(x: np.ndarray, k: int) -> np.ndarray:
    """(n,) distance of each sample to the k-th nearest of the others; (n,) in order of size."""
    padded = np.pad(x, k, constant_values=(-np.inf, np.inf))
    n = len(x)
    return np.min([np.maximum(x - padded[i : i + n], padded[i + k : i + k + n] - x) for i in range(k + 1)], axis=0)


def wasserstein(real: np.ndarray, simulated: np.ndarray, points: int = 200) -> np.ndarray:
    """First Wasserstein distance, in shares of the real samples' range (so that statistics can be added).

    The range is that of the bins of `js`, which a few outliers do not stretch. Where it is less than `NARROW` of what
    range and simulated samples span together, as of a statistic that is constant on the robot, the distance is in
    shares of `NARROW` of the latter: 1 / `NARROW` at most.
    """
    finite = _finite(real)
    levels = (np.arange(points) + 0.5) / points
    limits = Binning.of(finite)
    low, high = limits.low, limits.high
    wanted = np.clip(np.quantile(finite, levels), low, high)

    def distance(row: np.ndarray) -> float:
        if not row.size:
            return 1 / NARROW
        span = max(high - low, NARROW * (max(row.max(), high) - min(row.min(), low)))
        return float(np.abs(np.quantile(row, levels) - wanted).mean() / span)

    return np.array([distance(_finite(row)) for row in simulated])


def _finite(row: np.ndarray) -> np.ndarray:
    return row[np.isfinite(row)]


def mmd(real: np.ndarray, simulated: np.ndarray, most: int = 400) -> np.ndarray:
    """Squared maximum mean discrepancy under a Gaussian kernel (Gretton et al. 2012), between 0 and 2.

    The kernel is as wide as the median distance between real samples. At most `most` samples of either side count,
    evenly spaced in order of size, so nothing is random.
    """
    a = _thinned(np.sort(_finite(real)), most)
    between = np.abs(a[:, None] - a)
    apart = between[np.triu_indices(len(a), 1)]
    width = float(np.median(apart)) if apart.size else 0.0
    width = width if width > 0 else max(float(np.ptp(a)), 1e-9 * max(abs(float(a.max())), 1e-3))

    def kernel(x: np.ndarray, y: np.ndarray) -> float:
        return float(np.exp(-0.5 * ((x[:, None] - y) / width) ** 2).mean())

    own = kernel(a, a)
    rows = [_thinned(np.sort(_finite(row)), most) for row in simulated]
    return np.array([max(own + kernel(b, b) - 2 * kernel(a, b), 0.0) if b.size else 2.0 for b in rows])


def _thinned(values: np.ndarray, most: int) -> np.ndarray:
    return _spread(values, most) if len(values) > most else values


DIVERGENCES: dict[str, Divergence] = {"js": js, "js_nearest": js_nearest, "wasserstein": wasserstein, "mmd": mmd}


@functools.cache
def library() -> dict[str, Divergence]:
    """Every divergence by name: the built-in ones, then the user's own."""
    return DIVERGENCES | user_files.load_all("divergences", "DIVERGENCE", unusable, set(DIVERGENCES))


def unusable(measure: Divergence) -> str:
    """ "" or why a function is no divergence: tried on samples whose answer must be small, then large."""
    if not callable(measure):
        return "DIVERGENCE is no function"
    real = np.linspace(0.0, 1.0, 60)
    values = np.asarray(measure(real, np.stack([real, real + 3.0])))
    if values.shape != (2,):
        return f"gave shape {values.shape} for 2 simulations, must be (2,)"
    if not np.isfinite(values).all() or not values[0] < values[1]:
        return f"gave {values[0]:g} for equal samples and {values[1]:g} for distant ones; must be finite and grow"
    return ""


def divergence(name: str) -> Divergence:
    """The divergence of that name.

    Raises:
      UnknownNameError: there is none.
    """
    if name not in library():
        raise UnknownNameError("divergence", name, tuple(library()))
    return library()[name]


def measured(name: str, real: np.ndarray, simulated: np.ndarray) -> np.ndarray:
    """(N,) divergences of (N, m) samples, inf where the divergence gives NaN: no better than any.

    Raises:
      UnknownNameError: there is none of this name.
      InferError: the divergence, which may be the user's, fails or gives another shape.
    """
    measure = divergence(name)
    try:
        values = np.asarray(measure(real, simulated), float)
    except Exception as e:
        file = getattr(getattr(measure, "__code__", None), "co_filename", name)
        raise InferError(f"divergence {name} fails: {told(e, file)}") from e
    if values.shape != simulated.shape[:1]:
        raise InferError(f"divergence {name} gave shape {values.shape}, must be {simulated.shape[:1]}")
    return np.where(np.isnan(values), np.inf, values)
