"""Gaps of a recording: where samples or commands are missing, and what must not be compared because of them.

A simulation gets the commands that were recorded, the last one being held. A robot on feet gets them in a steady flow,
and goes limp after two periods without. Where several are missing, or one came so late, it was told something else, or
nothing; either way the error says nothing about the model from the moment the first was due, and to the end, since what
the robot did in between stays in its feet, its place and its posture. One missing command counts as never sent, and is
said; one that came a little late acts when it came. A test bench, or any log of commands that act at once, may hold
only what changes, so that nothing is missing from its commands.
"""

from dataclasses import dataclass

import numpy as np

from tcbi_sim.measurement import Commands, Measurement

GAP_S = 0.1  # the least that counts as a gap
GAP_PERIODS = 5  # a gap in samples is also longer than so many sample periods
COMMAND_PERIODS = 2.2  # a gap in commands: after two periods of silence a robot goes limp; the rest is jitter
MISSING_ONE = 1.5  # command periods
LATE = 0.75  # command periods: as short a step after a long one, and the command was late
REGULAR = 1.3  # steps of a steady stream of commands, in periods; only such a stream can lack one
AVERAGE_S = 0.05  # body rates and contacts are compared as averages, which reach so far


@dataclass(frozen=True)
class Gap:
    """From the last one before (s) to the first one after; infinity if none came."""

    begin: float
    end: float

    @property
    def length(self) -> float:
        """Seconds."""
        return self.end - self.begin


def sample_gaps(time: np.ndarray) -> list[Gap]:
    """Where a stream of samples (stamps (T,) in s) stops for longer than it should."""
    if len(time) < 3:
        return []
    return _longer(time, max(GAP_S, GAP_PERIODS * float(np.median(np.diff(time)))))


def command_gaps(commands: Commands, end: float, periods: float = COMMAND_PERIODS) -> list[Gap]:
    """Where a steady stream of commands lacks some; none for a stream that comes only when it has to.

    Args:
      end: of the rollout, s; a stream that stops before is one gap more.
      periods: a gap is longer than so many.
    """
    if len(commands.time) < 4:
        return []
    steps = np.diff(commands.time)
    period = float(np.median(steps))
    if np.quantile(steps, 0.75) > REGULAR * period:
        return []
    limit = max(GAP_S, periods * period)
    found = _longer(commands.time, limit)
    if end - commands.time[-1] > limit:
        found.append(Gap(float(commands.time[-1]), np.inf))
    return found


def _longer(time: np.ndarray, limit: float) -> list[Gap]:
    return [Gap(float(time[k]), float(time[k + 1])) for k in np.flatnonzero(np.diff(time) > limit).tolist()]


def untold(m: Measurement) -> list[Gap]:
    """Where it is not known what the joints were asked: what is missing, and on until a new command is carried out.

    A gap in the samples may have cost commands too, unless there are some inside.
    """
    time, ramp = m.commands.time, m.commands.ramp
    if not len(time):
        return []
    found = []
    for gap in sample_gaps(m.time):
        if not np.any((time > gap.begin) & (time < gap.end)):
            later = time[time >= gap.end]
            found.append(Gap(gap.begin, float(later[0]) + ramp if len(later) else np.inf))
    if _flows(m):
        end = min(m.scenario.duration, float(m.time[-1]))
        period = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
        found += [Gap(gap.begin + period, gap.end + ramp) for gap in command_gaps(m.commands, end)]
    return found


def _flows(m: Measurement) -> bool:
    """Whether commands came in a steady flow: ramps, to a robot on feet; of steps a log may hold the changes alone."""
    return bool(m.foot_names) and m.commands.ramp > 0


@dataclass(frozen=True)
class Unusable:
    """Which times of a rollout must not be compared.

    Attributes:
      samples: (T,) bool, of single samples.
      averages: (T,) bool, of averages over a few samples, which reach into a gap from beside it.
      signals: (T,) bool of each signal that has gaps of its own, by the field of Measurement.
      sentences: why, and how much.
    """

    samples: np.ndarray
    averages: np.ndarray
    signals: dict[str, np.ndarray]
    sentences: tuple[str, ...]


def unusable(m: Measurement, time: np.ndarray) -> Unusable:
    """What the gaps of a rollout spoil.

    Args:
      time: (T,) s, where it would be compared.
    """
    samples = np.zeros(len(time), bool)
    averages = samples.copy()
    sentences = []
    for gap in sample_gaps(m.time):
        samples |= (time > gap.begin + 1e-6) & (time < gap.end - 1e-6)
        averages |= _around(gap, time)
        sentences.append(f"No samples from {gap.begin:.2f} to {gap.end:.2f} s: left out of every error")
    signals: dict[str, np.ndarray] = {}
    for name, begin, stop in m.gaps:
        signals[name] = signals.get(name, np.zeros(len(time), bool)) | _around(Gap(begin, stop), time)
    if not _flows(m):
        return Unusable(samples, samples | averages, signals, tuple(sentences))
    end = min(m.scenario.duration, float(m.time[-1]))
    for gap in command_gaps(m.commands, end)[:1]:
        due = gap.begin + float(np.median(np.diff(m.commands.time)))
        samples |= time > due
        until = f"to {gap.end:.2f} s" if np.isfinite(gap.end) else "s on"
        sentences.append(
            f"No commands from {gap.begin:.2f} {until}, so the model is not told what the robot was: left out of every "
            f"error from {due:.2f} s on"
        )
    return Unusable(samples, samples | averages, signals, (*sentences, *_single(m.commands, end)))


def _around(gap: Gap, time: np.ndarray) -> np.ndarray:
    """(T,) bool: inside a gap, or so near that an average reaches into it."""
    return (time > gap.begin - AVERAGE_S) & (time < gap.end + AVERAGE_S)


def _single(commands: Commands, end: float) -> list[str]:
    """A sentence where single commands are missing; one that came late leaves a short step behind the long one."""
    period = float(np.median(np.diff(commands.time))) if len(commands.time) > 1 else 0.0
    after = dict(zip(commands.time[:-1].tolist(), np.diff(commands.time).tolist(), strict=True))
    gaps = [
        g
        for g in command_gaps(commands, end, MISSING_ONE)
        if g not in command_gaps(commands, end) and after.get(g.end, period) > LATE * period
    ]
    if not gaps:
        return []
    at = ", ".join(f"{g.begin:.2f}" for g in gaps[:3]) + (" …" if len(gaps) > 3 else "")
    return [f"After the command at {at} s one is missing: it counts as never sent"]
