"""Lags and rates of the clocks behind a recording, told apart from latencies of the robot where that can be done.

A joint follows its command after some latency, and so does a whole robot: a lag that all signals share, in all
rollouts, may be either. An artefact of the clocks it is for certain where it is negative (nothing moves before it is
told to), or where one rollout has it and its repeat has not (a robot's latency does not come and go). Those are taken
out. A lag of some joints alone is never touched.
"""

import dataclasses
from collections.abc import Sequence
from functools import cached_property

import numpy as np

from tcbi_infer.compare.replicates import by_torque, find_replicates
from tcbi_infer.compare.signals import Layout, reference
from tcbi_infer.gaps import untold
from tcbi_infer.readings import shifted
from tcbi_sim.measurement import Measurement

MOVES = np.radians(2.0)  # rad, standard deviation of a command that counts as motion
STEP, COARSE, REACH = 0.005, 0.02, 1.0  # s, of the lags tried
BETWEEN_REACH = 0.3  # s, of the lags tried between repeats
MOST_JOINTS = 6  # that a lag or rate is read from
LEAST_SAMPLES = 20  # that tell anything of a clock
LEADS, LONGEST = -0.04, 0.45  # s; less is impossible for a robot, more is no servo's latency
NEARLY = 1.15  # times what the best lag misses: lags that explain a slow motion as well
BETWEEN = 0.03  # s by which repeats must differ in lag for a finding
AGREE = 0.015  # s within which signals share a lag
OFF_UNIT = 5.0  # times its command that a joint in rad never moves
FOLLOWS = 0.3  # share of a motion's variance that a joint may owe to other things than its command
ALIAS = 2.0  # by which an impossible lag must beat every possible one
SHARPER = 3.0  # by which the best lag must beat a typical one; a steady ramp looks the same at any
FASTEST, LEAST_RATE = 0.25, 0.029  # of a clock's rate, beyond 1; less is found by chance in a few seconds
WELL = 0.02  # share missed below which no other rate is looked for
RATE_GAIN = 1.3  # by which the right rate of the clock must leave more unexplained than another
SURE_GAIN, SAME_RATE = 3.0, 0.04  # the same in a single rollout; how far rollouts may be apart
DRIFT = 0.12  # s that another rate must make over a rollout; a lag that changes with speed makes less


@dataclasses.dataclass(frozen=True)
class Aligned:
    """Rollouts whose clocks' artefacts are taken out, and what was found in each."""

    measurements: tuple[Measurement, ...]
    findings: tuple[tuple[str, ...], ...]


class Following:
    """How the joints of a rollout follow their commands, at any lag and any rate of the clock.

    Args:
      m: the rollout.
      moves: rad, standard deviation of a command that counts as motion.
    """

    def __init__(self, m: Measurement, moves: float = MOVES) -> None:
        self.measurement, self.told, self._moves = m, False, moves
        if not len(m.commands.time) or len(m.time) < LEAST_SAMPLES or by_torque(m):
            return
        self._begin = m.time[0] - REACH
        grid = np.arange(self._begin, m.time[-1] + REACH + STEP, STEP)
        asked = reference(m, grid)
        moving = (np.std(asked, axis=0) > moves) & (np.std(m.joint_position, axis=0) > 1e-6)
        self.joints = np.nonzero(moving)[0]
        self.told = bool(len(self.joints))
        self._asked, self._seen = asked[:, moving], m.joint_position[:, moving]
        most = np.argsort(-np.std(self._asked, axis=0))[:MOST_JOINTS]
        self._asked_most, self._seen_most = (np.ascontiguousarray(v[:, most]) for v in (self._asked, self._seen))
        self._known = np.ones(len(grid), bool)
        for gap in untold(m):
            self._known &= (grid <= gap.begin) | (grid >= gap.end)
        self.told &= bool(self.known().sum() >= LEAST_SAMPLES)

    def asked(self, lag: float = 0.0, rate: float = 1.0) -> np.ndarray:
        """(T, moving joints) rad asked at the samples' times as a clock of this lag (s) and rate would have them."""
        return self._asked[self._places(lag, rate)]

    def known(self, lag: float = 0.0, rate: float = 1.0) -> np.ndarray:
        """(T,) bool: samples at which it is known what was asked; false where a gap may have cost commands."""
        return self._known[self._places(lag, rate)]

    def pairs(self, lag: float = 0.0, rate: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
        """(N, moving joints) rad asked and as many seen, at the N samples at which it is known what was asked."""
        known = self.known(lag, rate)
        return self.asked(lag, rate)[known], self._seen[known]

    def missed(self, lag: float = 0.0, rate: float = 1.0, among: np.ndarray | None = None) -> float:
        """Share of the variance of the joints that move most, which their commands do not explain, at any gain.

        Args:
          among: (T,) bool, samples that count; None for all at which it is known what was asked.
        """
        places = self._places(lag, rate)
        among = self._known[places] if among is None else among
        if among.sum() < LEAST_SAMPLES:
            return 1.0
        asked, seen = self._asked_most[places[among]], self._seen_most[among]
        return float(np.mean(1.0 - correlation(asked, seen) ** 2))

    def _both_missed(self, lag: float, other: tuple[float, float]) -> tuple[float, float]:
        """What a lag misses, and what another lag and rate do, at the samples at which both know what was asked."""
        among = self.known(lag) & self.known(*other)
        return self.missed(lag, among=among), self.missed(*other, among=among)

    def _places(self, lag: float, rate: float) -> np.ndarray:
        """(T,) where on the grid a clock of this lag (s) and rate would have the samples."""
        m = self.measurement
        at = m.time[0] + (m.time - m.time[0]) * rate - lag
        index = np.round((at - self._begin) / STEP).astype(int)
        return np.clip(index, 0, len(self._asked) - 1)

    @cached_property
    def gain(self) -> np.ndarray:
        """(moving joints) how many times as far as asked each joint moves, once it has left its start."""
        m = self.measurement
        settled = self.known() & (m.time > m.commands.time[0] + m.commands.ramp + 0.2)
        asked, seen = self.asked(0.0)[settled], self._seen[settled]
        if not settled.any():
            return np.full(len(self.joints), np.nan)
        size = np.std(asked, axis=0)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(size > self._moves / 2, np.std(seen, axis=0) / size, np.nan)

    @property
    def off_unit(self) -> bool:
        """Whether the joints move so many times as far as asked that their positions are in another unit than rad."""
        return self.told and bool(np.isfinite(self.gain).any() and np.nanmedian(self.gain) > OFF_UNIT)

    def seconds(self) -> float:
        """How long it is known what was asked of joints that move."""
        return float(self.known().mean() * (self.measurement.time[-1] - self.measurement.time[0])) if self.told else 0.0

    @cached_property
    def lag(self) -> float:
        """The lag (s) at which the joints together follow best; NaN if the motion does not tell."""
        if not self.told:
            return float("nan")
        coarse = np.arange(-REACH, REACH + COARSE / 2, COARSE)
        typical = np.array([self.missed(lag) for lag in coarse])
        near = float(coarse[int(np.argmin(typical))])
        possible = (coarse > LEADS) & (coarse < LONGEST)
        if typical[possible].min() < ALIAS * typical.min():  # a periodic motion looks the same a period later
            near = float(coarse[possible][int(np.argmin(typical[possible]))])
        fine = near + np.arange(-COARSE, COARSE + STEP / 2, STEP)
        missed = [self.missed(lag) for lag in fine]
        best = int(np.argmin(missed))
        clear = missed[best] < FOLLOWS and np.median(typical) > SHARPER * missed[best]
        return float(fine[best]) if clear and abs(near) < REACH - COARSE / 2 else float("nan")

    @cached_property
    def leads(self) -> bool:
        """Whether no lag that a robot could have explains the motion nearly as well; a slow one may seem to lead."""
        if not self.lag <= LEADS:
            return False
        both = (self._both_missed(lag, (self.lag, 1.0)) for lag in np.arange(LEADS / 2, LONGEST, COARSE))
        return all(possible > NEARLY * least for possible, least in both)

    @cached_property
    def rate(self) -> tuple[float, float]:
        """The rate of the samples' clock over that of the commands', and how much better it explains the motion than 1.

        The rate is 1 unless another one explains the motion better and makes more than a lag that changes with speed.
        """
        if not self.told:
            return 1.0, 1.0
        lags = np.arange(-REACH, REACH, 2 * COARSE)
        right = min(self.missed(lag) for lag in lags)
        if right < WELL:
            return 1.0, 1.0
        length = float(self.measurement.time[-1] - self.measurement.time[0])
        step = float(np.clip(0.1 / length, 0.002, 0.02))
        rates = 1.0 + step * np.arange(-round(FASTEST / step), round(FASTEST / step) + 1)
        tried = [(lag, rate) for rate in rates for lag in np.arange(-0.04, 0.25, 2 * COARSE)]
        missed = [self.missed(*other) for other in tried]
        least = int(np.argmin(missed))
        rate = float(tried[least][1])
        explains = missed[least] < min(FOLLOWS, right / RATE_GAIN)
        if not explains or abs(rate - 1) <= max(LEAST_RATE, DRIFT / length):
            return 1.0, 1.0
        gain = min(one / max(other, 1e-9) for one, other in (self._both_missed(lag, tried[least]) for lag in lags))
        return (1.0 / rate, gain) if gain > RATE_GAIN else (1.0, 1.0)


def clock_rate(followings: Sequence[Following]) -> float:
    """The rate of the samples' clock that most rollouts agree on, or that one alone leaves no doubt of; else 1.

    A servo at its limits may look like a wrong rate in one motion, but not like the same one in others.
    """
    told = [f.rate for f in followings if f.told]
    found = np.array([rate for rate, _ in told if rate != 1.0])
    if len(told) == 1 and len(found):
        return float(found[0]) if told[0][1] > SURE_GAIN else 1.0
    if len(found) < 2 or len(found) < len(told) / 2 or np.abs(found - np.median(found)).max() > SAME_RATE:
        return 1.0
    return float(np.median(found))


def correlation(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(J,) correlation of each column of `a` with the same one of `b`; 0 where one stands still."""
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    size = np.sqrt((a**2).sum(axis=0) * (b**2).sum(axis=0))
    return np.where(size > 0, (a * b).sum(axis=0) / np.where(size > 0, size, 1.0), 0.0)


def aligned(measurements: Sequence[Measurement], followings: Sequence[Following] | None = None) -> Aligned:
    """Takes out what only the clocks can have done; what may be a latency stays."""
    followings = followings or [Following(m) for m in measurements]
    lags = np.array([np.nan if f.off_unit else f.lag for f in followings])
    leading = np.array([f.leads and not f.off_unit for f in followings], bool)
    shift, usual = _leads(lags, leading, followings)
    findings: list[list[str]] = [[] for _ in measurements]
    for r in np.flatnonzero(shift):
        lead = f" by {-1000 * lags[r]:.0f} ms" if leading[r] else ", as those of other rollouts show"
        findings[r].append(
            f"The joints lead their commands{lead}: the streams are stamped by different clocks. "
            f"All its signals are compared {1000 * shift[r]:.0f} ms later; their common latency cannot be told"
        )
    moved = [_shifted(m, s) for m, s in zip(measurements, shift, strict=True)]
    replayable = [r for r, m in enumerate(moved) if len(m.commands.time)]
    for group in find_replicates([moved[r] for r in replayable]):
        members = [replayable[i] for i in group.members]
        for i, late in _odd_repeats([moved[r] for r in members], usual).items():
            k = members[i]
            moved[k] = _shifted(moved[k], -late)
            findings[k].append(
                f"All signals come {1000 * abs(late):.0f} ms {'later' if late > 0 else 'earlier'} than when the same "
                "commands were repeated: an artefact of the clocks, taken out before any error is measured"
            )
    return Aligned(tuple(moved), tuple(tuple(f) for f in findings))


def _leads(lags: np.ndarray, leading: np.ndarray, followings: Sequence[Following]) -> tuple[np.ndarray, float]:
    """By how much (s) each rollout is to come later, as its joints lead their commands, and the lag of the others.

    Where most of them lead alike it is one clock, which leads in all whose motion does not speak against it.

    Args:
      lags: (R,) s, NaN where a motion does not tell.
      leading: (R,) bool, rollouts that no lag of a robot explains.
      followings: (R) how joints follow.
    """
    known = np.isfinite(lags)
    sound = known & (lags > LEADS) & (lags < LONGEST)
    usual = float(np.median(lags[sound])) if sound.any() else 0.0
    shift = np.where(leading, usual - lags, 0.0)
    if not leading.any():
        return shift, usual
    middle = float(np.median(lags[leading]))
    alike = known & (lags < 0) & (np.abs(lags - middle) <= 2 * BETWEEN)
    if 2 * alike.sum() <= known.sum():
        return shift, usual
    allows = [f.missed(middle) <= NEARLY * f.missed(lag) for f, lag in zip(followings, lags, strict=True) if lag == lag]
    one_clock = ~known | alike
    one_clock[known] |= np.array(allows, bool)
    return np.where(one_clock, -middle, shift), 0.0


def _shifted(m: Measurement, by: float) -> Measurement:
    if not by:
        return m
    gaps = tuple((name, begin + by, end + by) for name, begin, end in m.gaps)
    return dataclasses.replace(m, time=m.time + by, gaps=gaps, readings=shifted(m.readings, by))


def _odd_repeats(repeats: Sequence[Measurement], usual: float) -> dict[int, float]:
    """Which repeats of one motion come late as a whole (s, negative for early), measured from the most usual one."""
    if len(repeats) < 2:
        return {}
    late = np.array([common_shift(repeats[0], m) for m in repeats])
    if not np.isfinite(late).any():
        return {}
    first = Following(repeats[0]).lag
    lags = late + (first if np.isfinite(first) else usual)
    aim = float(np.nanmedian(lags)) if len(repeats) > 2 else usual
    late = late - late[int(np.nanargmin(np.abs(lags - aim)))]
    return {r: float(late[r]) for r in range(len(repeats)) if np.isfinite(late[r]) and abs(late[r]) >= BETWEEN}


def common_shift(a: Measurement, b: Measurement) -> float:
    """By how much (s) all signals of `b` come later after their commands than those of a repeat `a`.

    NaN unless nearly all moving signals, joints and body alike, agree on it.
    """
    rate = 1.0 / STEP
    asked = float(np.mean(b.commands.time - a.commands.time)) if len(a.commands.time) == len(b.commands.time) else 0.0
    end = min(a.time[-1], b.time[-1])
    time = np.arange(max(a.time[0], b.time[0]), end, STEP)
    if len(time) < 4 * BETWEEN_REACH * rate:
        return float("nan")
    layout = Layout.of([a, b], rate)
    use = [
        i for i, c in enumerate(layout.channels) if c.group.name in ("joint_position", "attitude", "angular_velocity")
    ]
    first, second = (layout.extract(m.resampled(time))[:, use] for m in (a, b))
    reach = round(BETWEEN_REACH / STEP)
    middle = slice(reach, len(time) - reach)
    core = first[middle]
    width = len(core)
    missed = np.stack(
        [1.0 - correlation(core, second[reach + k : reach + k + width]) ** 2 for k in range(-reach, reach + 1, 2)]
    )
    best = np.argmin(missed, axis=0)
    clear = (missed.min(axis=0) < FOLLOWS) & (np.median(missed, axis=0) > SHARPER * missed.min(axis=0))
    shifts = (2 * best[clear] - reach) * STEP
    if not len(shifts):
        return float("nan")
    middle_shift = float(np.median(shifts))
    agree = np.mean(np.abs(shifts - middle_shift) <= AGREE)
    return middle_shift - asked if agree > 0.8 else float("nan")
