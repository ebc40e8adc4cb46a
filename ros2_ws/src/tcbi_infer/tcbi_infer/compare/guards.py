"""Checks of the recording itself, made before any error is shown; each finding is a plain sentence.

A recording with the wrong clock or swapped joints fits no model, and a diagnosis of it would name physics for a
mistake of the wiring.
"""

import itertools
import re
from collections import Counter
from collections.abc import Sequence

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from tcbi_contract.wording import some
from tcbi_infer.compare.body_guards import check_body
from tcbi_infer.compare.clocks import LONGEST, Following, aligned, clock_rate
from tcbi_infer.compare.imu_guards import check_imu
from tcbi_infer.compare.replicates import by_torque, find_replicates, nearly_repeats
from tcbi_infer.compare.wiring import echo, units, wiring
from tcbi_infer.gaps import sample_gaps, unusable
from tcbi_infer.spikes import without_spikes
from tcbi_sim.measurement import Measurement
from tcbi_sim.rigs import load_rig, missing_sensors, rig_names

LEAST = 10  # samples that tell anything
SAME = 1e-9  # rad: what differs by less is the same reading again
HELD = 0.4  # share of repeated samples in motion that is no chance
SIGNALS = ("attitude", "angular_velocity", "linear_acceleration", "contact", "position")  # that may be missing
FEW_GAPS = 5  # that are told each; a stream with more comes in bursts
CUT = 0.3  # s by which a recording ends before its repeat, which no jitter of the end explains
APART = 0.01  # s between the same command in two repeats, which a joint at 2 rad/s turns into more than a degree
ALONE = ": the repeat counts alone there"
IDLE = 0.05  # of the noise floor: a parameter that moves every signal less than this changes nothing
IDLE_SPAN = (0.2, 0.8)  # of its range
STEPS = 5.0  # encoder steps between two samples in which a value must change
SAMPLE_GAPS = (2e-4, 0.5)  # s between samples, beyond which the times rather have another unit
FROZEN_S = 1.5  # s in which a joint stays within STILL while its command goes FROZEN to and fro
STILL, FROZEN = 0.005, 0.6  # rad; dry friction holds a soft servo (kp 100 to 800 of an XL330) against 0.3


def idle_parameter(name: str) -> str:
    """The finding that nothing recorded depends on a parameter of the model."""
    return f"The model's parameter {name} changes nothing in these rollouts."


def guard(measurements: Sequence[Measurement]) -> list[str]:
    """Findings about the recordings and what their reader had to leave out, each told once for several rollouts."""
    measurements = [without_spikes(m) for m in measurements]
    followings = [Following(m) for m in measurements]
    sane = [_in_units(m, following) for m, following in zip(measurements, followings, strict=True)]
    rate = clock_rate(followings) if all(sane) else 1.0  # in another unit every clock looks wrong
    clocks, odd = aligned(measurements, followings).findings, _uneven_repeats(measurements)
    near, wired = _no_repeats(measurements), _wired(measurements, followings)
    findings = [
        [*m.notes, *_check(m, following), *_rate(rate), *itertools.chain(*others)]
        for m, following, *others in zip(measurements, followings, wired, clocks, odd, near, strict=True)
    ]
    sentences = [_sentence(finding, who, measurements) for finding, who in _by_finding(findings).items()]
    return sentences + _sources(measurements) + _copies(measurements)


def to_mend(measurements: Sequence[Measurement]) -> list[str]:
    """Findings to which no physics must be fitted: wrong units or commands that most rollouts share, and joints that
    all rollouts together show to be wired wrongly."""
    replayed = [without_spikes(m) for m in measurements if len(m.commands.time)]  # the others are left out anyway
    ordered = [(m, Following(m)) for m in replayed if _ordered(m)]
    findings = []
    for m, following in ordered:
        found = [*units(m, following), *echo(m, following)]
        findings.append([(re.sub(r"\d+", "", finding), finding) for finding in found])
    shared = Counter(kind for own in findings for kind in dict(own))
    wired = wiring(*zip(*ordered, strict=True)) if ordered else []
    often = [[*(finding for kind, finding in own if shared[kind] > len(replayed) / 2), *wired] for own in findings]
    sound = [m for m, _ in ordered]
    return [_sentence(finding, who, sound) for finding, who in _by_finding(often).items()]


def _is_copy(m: Measurement, first: Measurement) -> bool:
    both = min(len(m.time), len(first.time))
    pairs = [(getattr(m, name), getattr(first, name)) for name in ("joint_position", *SIGNALS)]
    measured = [(a[:both], b[:both]) for a, b in pairs if a is not None and b is not None]
    return both >= LEAST and all(np.array_equal(a, b, equal_nan=a.dtype.kind == "f") for a, b in measured)


def _wired(measurements: Sequence[Measurement], followings: Sequence[Following]) -> list[list[str]]:
    """Of each recording, the joints that are wired wrongly: in all of them together or, if none is, in it alone."""
    ordered = [_ordered(m) for m in measurements]
    pairs = [(m, f) for m, f, sound in zip(measurements, followings, ordered, strict=True) if sound]
    shared = wiring(*zip(*pairs, strict=True)) if pairs else []
    return [
        shared or (wiring([m], [f]) if sound else [])
        for m, f, sound in zip(measurements, followings, ordered, strict=True)
    ]


def _by_finding(findings: Sequence[Sequence[str]]) -> dict[str, list[int]]:
    """In which rollouts each finding is, of the findings of each rollout."""
    where: dict[str, list[int]] = {}
    for r, own in enumerate(findings):
        for finding in dict.fromkeys(own):
            where.setdefault(finding, []).append(r)
    return where


def _sentence(finding: str, who: Sequence[int], measurements: Sequence[Measurement]) -> str:
    """A finding, with the rollouts that have it where there are several."""
    if len(measurements) == 1:
        return f"{finding}."
    if len(who) == len(measurements):
        return f"{finding} (all {len(who)} rollouts)."
    names = ", ".join(measurements[r].rollout_id for r in who[:3])
    return f"{finding} ({names}{f' and {len(who) - 3} more' if len(who) > 3 else ''})."


def _sources(measurements: Sequence[Measurement]) -> list[str]:
    """A sentence where a robot's and a simulation's rollouts are judged together."""
    sources = sorted({m.source for m in measurements})
    return [
        f"Rollouts of several sources ({', '.join(sources)}) are judged together: a model that fits one of them may "
        "fit the other not at all, so compare each by itself; they count as no repeats of each other."
    ] * (len(sources) > 1)


def unchecked(measurements: Sequence[Measurement]) -> tuple[str, ...]:
    """Rollouts whose joints tell nothing of their commands, so that no clock, wiring or unit can be checked by them."""
    pairs = [(m, Following(m)) for m in map(without_spikes, measurements)]
    return tuple(m.rollout_id for m, f in pairs if not f.told and not (_ordered(m) and units(m, f)))


def unchecked_line(unchecked: Sequence[str], rollouts: Sequence[str]) -> str:
    """What it means that clock, wiring and unit of some rollouts, by their ids, were not checked; "" for none."""
    if not unchecked:
        return ""
    none = len(unchecked) == len(rollouts)
    where = "" if none else f" in {len(unchecked)} of {len(rollouts)} rollouts ({some(unchecked)})"
    return (
        f"Clocks, wiring and units{where} could not be checked: the commands are torques, the joints hardly move (as "
        "they do where angles are in another unit than the mapping says), or there are too few samples."
    )


def _copies(measurements: Sequence[Measurement]) -> list[str]:
    """Recordings that agree with another to the last bit, as long as both last."""
    firsts: list[Measurement] = []
    copies = []
    for m in measurements:
        first = next((f for f in firsts if _is_copy(m, f)), None)
        if first is None:
            firsts.append(m)
        else:
            copies.append((m.rollout_id, first.rollout_id))
    if not copies:
        return []
    one, other = copies[0]
    more = f", and so are {len(copies) - 1} more" if len(copies) > 1 else ""
    return [
        f"{one} is {other} again to the last bit{more}: a simulation that repeats itself does not show how much a "
        "robot differs from itself, so such repeats count for no noise floor."
    ]


def _uneven_repeats(measurements: Sequence[Measurement]) -> list[list[str]]:
    """Of each recording, what it lacks that a repeat of the same commands has, and how far their commands lie apart."""
    findings: list[list[str]] = [[] for _ in measurements]
    whole = [r for r, m in enumerate(measurements) if len(m.commands.time) and len(m.time)]
    ends = [min(measurements[r].scenario.duration, float(measurements[r].time[-1])) for r in whole]
    for group in find_replicates([measurements[r] for r in whole]):
        has = {i: {s for s in SIGNALS if getattr(measurements[whole[i]], s) is not None} for i in group.members}
        every, last = set().union(*has.values()), max(ends[i] for i in group.members)
        for i in group.members:
            if missing := ", ".join(s for s in SIGNALS if s in every - has[i]):
                findings[whole[i]].append(f"A repeat of the same commands has {missing}, which is missing here{ALONE}")
            if last - ends[i] > CUT:
                findings[whole[i]].append(
                    f"Ends at {ends[i]:.1f} s, a repeat of the same commands at {last:.1f} s{ALONE}"
                )
        times = np.stack([measurements[whole[i]].commands.time for i in group.members])
        if (apart := float(np.ptp(times, axis=0).max())) > APART:
            findings[whole[group.members[0]]].append(
                f"Its commands and those of its repeats came up to {1e3 * apart:.0f} ms apart, and the noise floor "
                "counts what that changes as the robot's own: record them again when the machine has nothing else to do"
            )
    return findings


def _no_repeats(measurements: Sequence[Measurement]) -> list[list[str]]:
    """Of each recording that has no repeat: with which it would be one, and what keeps it from being it."""
    findings: list[list[str]] = [[] for _ in measurements]
    whole = [r for r, m in enumerate(measurements) if len(m.commands.time) and len(m.time)]
    groups = [[whole[i] for i in g.members] for g in find_replicates([measurements[r] for r in whole])]
    for k, (one, *repeats) in enumerate(groups):
        others = [group[0] for i, group in enumerate(groups) if i < k or (i > k and len(group) > 1)]
        reasons = ((other, nearly_repeats(measurements[one], measurements[other])) for other in others if not repeats)
        for other, why in itertools.islice(((other, why) for other, why in reasons if why), 1):
            findings[one].append(
                f"Asks for the same as {measurements[other].rollout_id}, but is no repeat of it: they differ in {why}"
            )
    return findings


def check_recording(m: Measurement, following: Following | None = None) -> list[str]:
    """Findings about one recording, without any model; what `aligned` takes out is its to tell."""
    following = following or Following(m)
    return _check(m, following) + (wiring([m], [following]) if _ordered(m) else [])


def _check(m: Measurement, following: Following) -> list[str]:
    """All but the wiring; in another unit every reading looks broken."""
    clock = _clock(m)
    if not _ordered(m):
        return clock
    wrong = units(m, following)
    return [
        *clock,
        *wrong,
        *unusable(m, m.time).sentences,
        *_held(m),
        *([] if wrong else _frozen(m)),
        *echo(m, following),
        *_lag(following),
        *_not_simulated(m),
        *check_imu(m),
        *check_body(m),
    ]


def _not_simulated(m: Measurement) -> list[str]:
    """Signals of the body that the rig's model has no sensor for."""
    if m.rig not in rig_names():
        return []
    left = [name for name in missing_sensors(load_rig(m.rig)) if getattr(m, name) is not None]
    told = ", ".join(left).replace("_", " ")
    return [f"The rig {m.rig} has no sensor for {told}: that is not compared"] if left else []


def _in_units(m: Measurement, following: Following) -> bool:
    """Whether positions and times are in the units that they should have, as far as that shows at once."""
    steps = np.diff(m.time)
    return not following.off_unit and (not len(steps) or SAMPLE_GAPS[0] <= np.median(steps) <= SAMPLE_GAPS[1])


def _ordered(m: Measurement) -> bool:
    """Whether there are samples to look at, one after another."""
    return len(m.time) >= LEAST and bool(np.all(np.diff(m.time) > 0))


def _clock(m: Measurement) -> list[str]:
    findings = []
    steps = np.diff(m.time)
    if len(m.time) < 10:
        return ["Fewer than ten samples: nothing can be compared"]
    if np.any(steps <= 0):
        findings.append("Time stamps repeat or go backwards")
    if abs(m.time[0]) > 1.0:
        findings.append("The samples start more than 1 s away from the rollout's begin: another clock, or a cut bag")
    gaps = [gap.begin for gap in sample_gaps(m.time)]
    unbroken = steps[~np.isin(m.time[:-1], gaps)] if len(gaps) <= FEW_GAPS else steps
    median, mean = float(np.median(steps)), float(np.mean(unbroken))
    if not SAMPLE_GAPS[0] <= median <= SAMPLE_GAPS[1]:
        findings.append(
            f"The samples come {_span(median)} apart: the times look as if they had another unit than seconds"
        )
    if mean > 1.2 * median:
        findings.append(f"The stream claims {1 / median:.0f} Hz but delivers {1 / mean:.0f} Hz")
    if m.commands.time.size and m.commands.time[0] > m.time[-1]:
        findings.append("All commands come after the last sample: commands and sensors run on different clocks")
    return findings


def _span(seconds: float) -> str:
    return f"{seconds:.3g} s" if seconds > 1 else f"{1e6 * seconds:.3g} us"


def _held(m: Measurement) -> list[str]:
    """A fast stream that repeats slow readings."""
    change = np.abs(np.diff(m.joint_position, axis=0))
    changed = change[change > SAME]
    if len(m.time) < 20 or not changed.size:
        return []
    step = float(changed.min())
    fast = max(STEPS * step, 0.1 * float(np.quantile(change.max(axis=1), 0.99)))
    width = 10
    spans = [slice(k, k + width) for k in range(0, len(change) - width, width)]
    moving = [s for s in spans if np.abs(m.joint_position[s.stop] - m.joint_position[s.start]).max() > width * fast / 2]
    if len(moving) < 3:
        return []
    repeated = float(np.mean([np.mean(~(change[s] > SAME).any(axis=1)) for s in moving]))
    if repeated < HELD:
        return []
    rate = 1.0 / float(np.median(np.diff(m.time)))
    changes = rate * (1 - repeated)
    return [f"The stream claims {rate:.0f} Hz but its joint positions change only {changes:.0f} times a second"]


def _frozen(m: Measurement) -> list[str]:
    """Joints that stay where they are while their command moves: a frozen reading, or a servo that does nothing."""
    if by_torque(m) or not m.commands.time.size:
        return []
    # targets, for the way to the first one does not count
    latest = np.clip(np.searchsorted(m.commands.time, m.time, side="right") - 1, 0, None)
    asked, width = m.commands.target[latest], int(np.searchsorted(m.time, m.time[0] + FROZEN_S))
    if width < 2 or width >= len(m.time):
        return []
    stays = np.ptp(sliding_window_view(m.joint_position, width, axis=0), axis=-1) < STILL
    way = np.concatenate([np.zeros_like(asked[:1]), np.cumsum(np.abs(np.diff(asked, axis=0)), axis=0)])
    still = stays & (way[width - 1 :] - way[: len(way) - width + 1] > FROZEN)
    found = []
    for j in np.flatnonzero(still.any(axis=0)):
        first = int(np.argmax(still[:, j]))
        end = first + int(np.argmin(np.append(still[first:, j], False))) - 1 + width
        moved, until = np.degrees(way[end - 1, j] - way[first, j]), m.time[end - 1]
        found.append(
            f"{m.joint_names[j]} stays where it is from {m.time[first]:.1f} to {until:.1f} s "
            f"while its command goes {moved:.0f} deg to and fro: its reading may be frozen, or its servo dead"
        )
    return found


def _lag(following: Following) -> list[str]:
    if following.lag >= LONGEST:
        return ["The joints follow their commands by half a second or more: check the clocks before blaming the servos"]
    return []


def _rate(rate: float) -> list[str]:
    if rate == 1.0:
        return []
    word = "fast" if rate > 1 else "slow"
    return [
        f"The sensors' clock runs {100 * abs(rate - 1):.0f} % {word} against that of the commands: the stream's "
        "rate is not what its stamps say"
    ]
