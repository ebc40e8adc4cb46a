"""The smallest size of each effect that these rollouts could have shown, from the screening's simulations alone.

A robot with an effect of some size would have been recorded as what nothing missing looks like (null.py) and the
effect's signature on top. Signatures are known from the screening, so that the search can be run on hundreds of such
data sets without another simulation. A size counts as shown where an effect would be named: in four data sets of five
the statistic passes the diagnosis's threshold, the error falls by the share that is asked of a useful effect, and the
interval leaves out the null value.
"""

import copy
import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.special import ndtri, stdtrit

from tcbi_contract.wording import with_unit
from tcbi_infer.compare.signals import ATTITUDE, GROUPS, JOINT, Group
from tcbi_infer.diagnose import paired
from tcbi_infer.diagnose.evidence import DetectableSize
from tcbi_infer.diagnose.heldout import imitated, shared_error
from tcbi_infer.diagnose.null import Null
from tcbi_infer.diagnose.problem import TAIL, Problem
from tcbi_infer.diagnose.screen import Screen, Targets
from tcbi_infer.diagnose.verdict import ELSEWHERE, NOTICEABLE, USEFUL
from tcbi_sim.parameter import Parameter

POWER = 0.8
DRAWS = 100  # null data sets that are looked at
SIZES = np.geomspace(0.005, 1.0, 16)  # of the way to the end of the range; signatures are not scaled down further
PARALLEL = 0.97  # cosine with what base parameters and joint scatter do, above which nothing can be told apart
MUCH = 20.0  # nats over all kinds of motion: an effect that gains this is seen, if only in some of them
CURVED = 1.3  # power of its size with which a signature grows that is curvature; 2 without a straight rest
STRAIGHT = 0.8  # least cosine between the signatures of two sizes, of which others may then be interpolated
LIMITS = ("the search", "the fall of the error", "the interval")


@dataclasses.dataclass(frozen=True)
class Background:
    """What the rollouts hold besides an effect.

    Attributes:
      null: data sets with nothing missing, and the threshold.
      error: over the noise floor, that the best model leaves on unseen motions.
      elsewhere: the same of each other kind of signal that fits look at, by its name.
      shared: how many channels err alike.
    """

    null: Null
    error: float
    elsewhere: Mapping[str, float]
    shared: float

    @staticmethod
    def of(null: Null, error: float, elsewhere: Mapping[str, float], residual: np.ndarray) -> "Background":
        """From the (S, T, C) residual that the best model leaves."""
        return Background(null, error, elsewhere, shared_error(residual))


def detectable_sizes(problem: Problem, screen: Screen, background: Background) -> tuple[DetectableSize, ...]:
    """The smallest size of every effect, parameter by parameter and either way from its null value.

    Args:
      problem: the data.
      screen: the screening of all uses.
      background: what the rollouts hold besides.

    Returns:
      In the order of the uses; those without influence last. None where fewer than two kinds of motion were recorded.
    """
    if background.null.kinds < 2:
        return ()
    sizes: list[DetectableSize] = []
    for u in range(len(screen.directions.uses)):
        sizes += _Use(problem, screen, background, u).sizes()
    nothing = "changes nothing that is measured in these rollouts"
    return (*sizes, *(DetectableSize(use, reason=nothing) for use in screen.directions.untestable))


def alone(screen: Screen, use: int) -> Screen:
    """The same screening of one use."""
    d, m = screen.directions, screen.moments
    mine = np.nonzero(d.use == use)[0]
    one = copy.copy(screen)
    one.directions = dataclasses.replace(
        d,
        uses=(d.uses[use],),
        models=(d.models[use],),
        use=np.zeros(len(mine), int),
        unit=tuple(d.unit[k] for k in mine),
        change=d.change[mine],
        least=d.least[mine],
        most=d.most[mine],
        untestable=(),
    )
    one.change = screen.change[mine]
    one.moments = dataclasses.replace(m, nk=m.nk[:, :, mine], kk=m.kk[:, mine])
    return one


@dataclasses.dataclass(frozen=True)
class _Ray:
    """One parameter moved away from its null value, all other sized ones at theirs.

    Attributes:
      parameter: index among the effect's own.
      way: 1 upwards, -1 downwards.
      place: the effect's parameters without a null value, in words.
      ks, lengths: the simulated directions along it, shortest first, and their lengths, of the way to the end of the
        range; negative where the direction was simulated the other way.
    """

    parameter: int
    way: int
    place: str
    ks: tuple[int, ...]
    lengths: tuple[float, ...]


class _Use:
    """One use: how the search answers to it at every size."""

    def __init__(self, problem: Problem, screen: Screen, background: Background, use: int) -> None:
        self.background, self.screen = background, alone(screen, use)
        self.key = screen.directions.uses[use]
        self.own: Sequence[Parameter] = screen.directions.models[use].parameters[screen.base_count :]
        null, mine = background.null, np.nonzero(screen.directions.use == use)[0]
        self.noise = Targets(null.targets.nr[..., :DRAWS], null.targets.kr[:, mine, :DRAWS])
        self.scale = null.scale[:DRAWS]
        self.signal = self.screen.targets(self.screen.change)
        m = self.screen.moments
        counted = (problem.weight[screen.sets] * problem.share[problem.group]).sum(axis=(1, 2))
        self.samples = np.array([counted[fold].sum() for fold in screen.folds])  # independent ones of each kind
        self.slope = np.linalg.solve(m.nn.sum(axis=0) + np.diag(m.prior), m.nk.sum(axis=0))  # (n, K)
        self.energy = m.kk.sum(axis=0)
        self.profiled = np.maximum(self.energy - np.einsum("nk,nk->k", m.nk.sum(axis=0), self.slope), 1e-12)
        self.useful = self._useful(problem)

    def _useful(self, problem: Problem) -> np.ndarray:
        """(K,) by how much the error of the signals that show a direction best falls with it, 1 where just enough."""
        screen, background = self.screen, self.background
        left = screen.change - np.einsum("sin,nk->ksi", screen.design, self.slope, optimize=True)
        left = left.reshape(len(left), len(screen.sets), *problem.observed.shape[1:])

        def visible(*groups: Group) -> np.ndarray:
            """(K,) root mean square over the floor, less what a refit absorbs."""
            channels = problem.replay.layout.where(*groups)
            weight = problem.weight[screen.sets][..., channels]
            squares = ((left[..., channels] / problem.floor[channels]) ** 2 * weight).sum(axis=(1, 2))
            return np.sqrt((squares / np.maximum(weight.sum(axis=(0, 1)), 1)).mean(axis=-1))

        falls = [visible(JOINT, ATTITUDE) / (background.error * np.sqrt(1.0 / (1.0 - USEFUL) ** 2 - 1.0))]
        for group in (g for g in GROUPS if g.name in background.elsewhere):
            error = background.elsewhere[group.name]
            enough = max(error**2 * (1.0 / (1.0 - ELSEWHERE) ** 2 - 1.0), NOTICEABLE**2 - error**2)
            falls.append(visible(group) / np.sqrt(enough))
        return np.max(falls, axis=0)

    def sizes(self) -> list[DetectableSize]:
        """One for each sized parameter and way: at its hardest place, or at the easiest if not shown at all of them."""
        rays = self._rays()
        found = []
        for key in dict.fromkeys((r.parameter, r.way) for r in rays):
            each = [self._size(r) for r in rays if (r.parameter, r.way) == key]
            shown = [s for s in each if s.value is not None]
            if len(shown) == len(each):
                found.append(dataclasses.replace(max(each, key=lambda s: s.share), place=""))
            else:
                found.append(min(shown, key=lambda s: s.share) if shown else dataclasses.replace(each[0], place=""))
        return found

    def _rays(self) -> list[_Ray]:
        null = np.array([float(p.to_unit(p.null)) if p.null is not None else np.nan for p in self.own])
        sized = np.isfinite(null)
        rays: dict[tuple[int, int, str], list[tuple[int, float]]] = {}
        for k, unit in enumerate(self.screen.directions.unit):
            moved = np.nonzero(sized & (np.abs(unit - null) > 1e-6))[0]
            if len(moved) != 1:
                continue
            (p,) = moved
            place = ", ".join(
                with_unit(f"{q.name.rpartition('.')[2]} {float(q.from_unit(v)):.3g}", q.unit)
                for q, v, s in zip(self.own, unit, sized, strict=True)
                if not s
            )
            both = np.isinf(self.screen.directions.least[k]) or self.screen.directions.least[k] < 0
            for way in (1, -1):
                room = 1 - null[p] if way > 0 else null[p]
                if room < 0.05 or not (both or way * (unit[p] - null[p]) > 0):
                    continue
                rays.setdefault((int(p), way, place), []).append((k, way * (unit[p] - null[p]) / room))
        sorted_rays = {key: sorted(ks, key=lambda k: abs(k[1])) for key, ks in rays.items()}
        return [_Ray(*key, *map(tuple, zip(*ks, strict=True))) for key, ks in sorted_rays.items()]  # type: ignore[arg-type]

    def _size(self, ray: _Ray) -> DetectableSize:
        p = self.own[ray.parameter]
        assert p.null is not None
        size = DetectableSize(self.key, p.name, p.unit, p.null, place=ray.place)
        if self._absorbed(ray):
            return dataclasses.replace(size, reason=self._likeness(ray.ks[0]))
        lengths = np.abs(ray.lengths)
        picked = np.argmin(np.abs(np.log(lengths / SIZES[:, None])), axis=1)
        smallest = SIZES[0]
        if not self._straight(ray):  # a threshold, perhaps: what is smaller than simulated may do nothing at all
            picked = np.maximum((lengths <= SIZES[:, None] * 1.001).sum(axis=1) - 1, 0)
            smallest = lengths.min()
        ks = np.array(ray.ks)[picked]
        multiples = SIZES / np.array(ray.lengths)[picked]
        power, gain = self._power(ks, multiples)
        margins = np.stack([power / POWER, self._usefulness(ks, multiples), self._distance(ks, multiples)])
        least = [max(_crossing(margin), smallest) for margin in margins]
        limit = int(np.argmax(least))
        if np.isfinite(least[limit]):
            null = float(p.to_unit(p.null))
            share = least[limit] * ((1 - null) if ray.way > 0 else null)
            value = float(p.from_unit(null + ray.way * share))
            decided = LIMITS[limit] if least[limit] > smallest else "nothing smaller is claimed"
            return dataclasses.replace(size, value=value, share=float(share), limit=decided)
        return dataclasses.replace(size, reason=self._why_not(int(ks[-1]), limit, float(gain[-1])))

    def _straight(self, ray: _Ray) -> bool:
        """Whether an effect of another size does the same in proportion, as far as two simulated sizes tell."""
        if len(ray.ks) < 2:
            return True
        small, large = ray.ks[0], ray.ks[-1]
        energy = self.signal.kr.sum(axis=0)
        if energy[small, small] <= 0 or energy[large, large] <= 0:
            return False
        cosine = energy[small, large] / np.sqrt(energy[small, small] * energy[large, large])
        growth = np.sqrt(energy[large, large] / energy[small, small]) / abs(ray.lengths[-1] / ray.lengths[0])
        return bool(abs(cosine) > STRAIGHT and 0.5 < growth < 2.0)

    def _absorbed(self, ray: _Ray) -> bool:
        """Whether what a refit leaves of an effect is curvature alone, which its next step would take too."""
        if len(ray.ks) < 2 or self._cosine(ray.ks[0]) < PARALLEL:
            return False
        growth = np.sqrt(self.profiled[ray.ks[-1]] / self.profiled[ray.ks[0]])
        return bool(growth > (ray.lengths[-1] / ray.lengths[0]) ** CURVED)

    def _cosine(self, k: int) -> float:
        """Between a direction and the best that base parameters and scatter can do."""
        return float(np.sqrt(np.clip(1.0 - self.profiled[k] / max(self.energy[k], 1e-12), 0.0, 1.0)))

    def _why_not(self, k: int, limit: int, gain: float) -> str:
        if self._cosine(k) > PARALLEL:
            return self._likeness(k)
        if limit == 0 and gain > MUCH:
            return "shows in too few kinds of motion to be held out"
        return f"too small in these rollouts at any size in its range: {LIMITS[limit]} would not tell"

    def _likeness(self, k: int) -> str:
        cosine = self._cosine(k)
        return f"looks like the model's own parameters and the scatter between joints (cosine {cosine:.3f})"

    def _power(self, ks: np.ndarray, multiples: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(G,) share of data sets in which the statistic passes, and the mean gain in nats, at each of G sizes."""
        count = len(self.scale)
        nr = self._with_signal(self.noise.nr, self.signal.nr[..., ks] * multiples)
        kr = self._with_signal(self.noise.kr, self.signal.kr[..., ks] * multiples)
        gains = self.screen.held_out(Targets(nr, kr))[:, 0].reshape(-1, len(ks), count)
        gains = robust_gain(gains, self.samples[:, None, None])
        power = (paired.statistic(gains, self.screen.sizes) > self.background.null.threshold).mean(axis=-1)
        return power, gains.sum(axis=0).mean(axis=-1)

    def _with_signal(self, noise: np.ndarray, signal: np.ndarray) -> np.ndarray:
        """(S, n, D) and (S, n, G) -> (S, n, G * D)."""
        both = noise[:, :, None, :] + signal[..., None] * self.scale
        return both.reshape(*both.shape[:2], -1)

    def _usefulness(self, ks: np.ndarray, multiples: np.ndarray) -> np.ndarray:
        """(G,) by how much the error falls, 1 where just enough."""
        return np.abs(multiples) * self.useful[ks]

    def _distance(self, ks: np.ndarray, multiples: np.ndarray) -> np.ndarray:
        """(G,) how far the interval stays from the null value, 1 where it just leaves it out."""
        known = self.profiled[ks] * np.median(self.scale) ** 2 / self.background.shared
        quantile = float(stdtrit(max(self.background.null.kinds - 1, 1), 0.95))
        hidden = imitated(self.screen.independent, self.background.error) / self.background.shared
        needed = (np.sqrt(quantile**2 + hidden) + ndtri(POWER)) / np.sqrt(known)
        return np.abs(multiples) / needed


def robust_gain(gain: np.ndarray, samples: np.ndarray) -> np.ndarray:
    """(F, ...) gain of the Student-t score with an estimated scale, from (F, ...) the gain in squared error, in nats.

    A model that lacks a strong effect takes its error for noise: it estimates a larger scale, and pays the logarithm of
    the error, not its square. For small gains the two are the same.

    Args:
      gain: half the fall of the squared error, in units of the noise, of each kind of motion.
      samples: (F, ...) independent ones of each.
    """
    excess = np.maximum(2.0 * gain / samples, -0.5)
    mean = np.maximum((excess * samples).sum(axis=0) / samples.sum(axis=0), 0.0)
    tail = (TAIL + 1.0) / 2.0 * np.log((TAIL + (1.0 + excess) / (1.0 + mean)) / (TAIL + 1.0))
    return samples * (0.5 * np.log1p(mean) + tail)


def _crossing(margin: np.ndarray) -> float:
    """The first of `SIZES` at which a margin reaches 1, between them on a logarithmic scale; infinite if none."""
    above = np.nonzero(margin >= 1.0)[0]
    if not len(above):
        return np.inf
    i = int(above[0])
    if i == 0:
        return float(SIZES[0])
    share = (1.0 - margin[i - 1]) / (margin[i] - margin[i - 1])
    return float(SIZES[i - 1] * (SIZES[i] / SIZES[i - 1]) ** share)


HEAD = ("effect", "parameter", "smallest size shown", "what decides")
TITLE = "The smallest size of each effect that these rollouts could have shown (in four of five recordings like these)"


def rows(sizes: Sequence[DetectableSize]) -> list[list[str]]:
    """[effect, parameter, smallest size, decided by] for people; of an effect with many sites the hardest one."""
    result = []
    keys = dict.fromkeys((s.effect, s.parameter.rpartition(".")[2]) for s in sizes)
    for effect, parameter in keys:
        mine = [s for s in sizes if (s.effect, s.parameter.rpartition(".")[2]) == (effect, parameter)]
        sites = len(dict.fromkeys(s.use for s in mine))
        name = mine[0].use if sites == 1 else f"{effect} ({sites} places)"
        shown = [s for s in mine if s.value is not None]
        if not shown:
            result.append([name, parameter, "none", mine[0].reason])
            continue
        hardest = {np.sign(s.value - s.null): s for s in sorted(shown, key=lambda s: s.share)}  # type: ignore[operator]
        texts = [_text(s) for _, s in sorted(hardest.items())]
        missed = sites - len(dict.fromkeys(s.use for s in shown))
        decided = max(hardest.values(), key=lambda s: s.share).limit
        rest = f"; not at every place: {missed} of {sites} not at all" if missed and sites > 1 else ""
        result.append([name, parameter, " or ".join(texts), decided + rest])
    return result


def _text(size: DetectableSize) -> str:
    value = with_unit(f"{size.value:.3g}", size.unit)
    nothing = "" if size.null == 0 else f" (none: {size.null:g})"
    return value + nothing + (f" at {size.place}" if size.place else "")
