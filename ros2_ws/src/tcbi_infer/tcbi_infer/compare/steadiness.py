"""Whether a robot repeats itself: what differs between repeats of the same commands is random to every model.

Commands that get lost or come in another order on their way make repeats differ by as much as the joints move. Errors
are told in multiples of that, so that hardly any effect can show, and a model that errs by no more says little.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import binomtest

from tcbi_infer.compare.noise import NoiseFloor
from tcbi_infer.compare.replay import Replay
from tcbi_infer.compare.signals import JOINT
from tcbi_sim.measurement import Commands
from tcbi_sim.rigs import load_rig

ERRATIC = 0.2  # of how far the joints move, that repeats differ by
LEAST = 1.0  # deg that they differ by at least
STEP = 0.15  # rad, root of the sum of squares over the joints, of a way to a target that is looked at
SHORTEST = 0.1  # s from one command to the next
MISSED, FOLLOWED = 0.35, 0.65  # of the usual response: at most, and at least; what lies between is not counted
FOLLOWS = 0.2  # of a way, that a robot's usual response is at least
LEAST_SHARE = 0.02  # of the commands, that is worth a word
LEAST_STEPS = 10  # pairs of responses from which a share is told
CLEAR = 0.6  # of the way to what another command leads to: at most what a motion stays away from its own
SLOW = 1 / 3  # of the usual response: as slow may be what a motion might be, that seems to follow another command
SEVERAL = 3.0  # joints asked to move at a command, each counted by its share of the squared way
BY_CHANCE, SURE = 0.05, 0.01  # of the commands let pass that look followed late, where all are lost; at this level


class Lost(NamedTuple):
    """The share of a robot's commands that seem to be lost, with its 90 % interval."""

    share: float
    low90: float
    high90: float


class Late(NamedTuple):
    """Of the commands that a robot let pass and then moved on, how many it followed when the next one was due."""

    late: int
    let_pass: int


def unsteady(replay: Replay, floor: NoiseFloor, late: Late | None) -> str:
    """A sentence where repeats of the same commands differ by much of how far the joints move; empty where not."""
    joints = replay.layout.where(JOINT)
    if not floor.from_replicates or not len(joints):
        return ""
    with np.errstate(invalid="ignore"):
        moved = np.nanmean(np.nanstd(replay.measured[..., joints], axis=1), axis=0)
    apart, share = floor.values[joints], floor.values[joints] / np.maximum(moved, 1e-9)
    if np.median(apart) < LEAST or np.median(share) < ERRATIC:
        return ""
    return (
        f"The robot does not repeat itself: asked for the same again, a joint is {np.median(apart):.1f} deg elsewhere "
        f"(root mean square, the median joint), {100 * np.median(share):.0f} % of how far it moves. "
        f"{_cause(replay, late)} Errors are told in multiples of this, so that hardly any effect can show."
    )


def _cause(replay: Replay, late: Late | None) -> str:
    if late:
        return (
            f"Of {late.let_pass} commands that it let pass it followed {late.late} when the next one was due: commands "
            "come late or in another order."
        )
    if lost := unfollowed(replay):
        return (
            f"Repeats differ in which commands they followed, as if some {100 * lost.share:.0f} % of the commands (90 "
            f"% interval {100 * lost.low90:.0f} to {100 * lost.high90:.0f} %) were lost, or came late or in another "
            "order."
        )
    return "Commands that get lost or come late do that, a supply that breaks down, loose contacts, slipping feet."


def unfollowed(replay: Replay) -> Lost | None:
    """The share of commands that a robot did not follow, from how often one of two repeats did and the other did not.

    Of the commands that one of two repeats followed at least, the other missed 2 p / (1 + p) if each misses with
    probability p; that share's interval is Clopper and Pearson's. Commands that both missed do not count: a servo that
    is too slow for them does that, too. Each repeat is in one pair, so that pairs are independent; one that followed
    nothing while the other did was limp. None where too few commands are large and apart enough, where the repeats
    follow them alike or hardly at all, and for a rig whose commands are torques.
    """
    if load_rig(replay.rig).kind != "position":
        return None
    pairs = [
        np.stack([_responses(replay, member, commands) for member in pair])
        for members, commands in zip(replay.repeats, replay.commands, strict=True)
        for pair in zip(members[::2], members[1::2], strict=False)
    ]
    usual = _usual(pairs)
    if usual < FOLLOWS:
        return None
    together = alone = 0
    for responses in pairs:
        missed, followed = responses < MISSED * usual, responses > FOLLOWED * usual  # neither of what is not known
        if followed.any(axis=1).all():
            together += int(followed.all(axis=0).sum())
            alone += int((missed.any(axis=0) & followed.any(axis=0)).sum())
    if together + alone < LEAST_STEPS:
        return None
    share = binomtest(alone, together + alone)
    interval = share.proportion_ci(0.9)
    lost = Lost(*(q / (2 - q) for q in (float(share.statistic), float(interval.low), float(interval.high))))
    return lost if lost.share >= LEAST_SHARE else None


def overtaken(replay: Replay) -> Late | None:
    """How many of the commands that a robot let pass it followed when the next one was due, if it is more than chance.

    A lost command is never followed. One that comes late, or swaps places with the next, is, though the next one was
    due. Which command a motion follows is told by its target, that of the last three to which it comes nearest. Counted
    is what follows a motion that did as the command before said, after one that was in time. Where a motion was
    repeated, another repeat must not have done so, too: else the robot may just be slow there. None where a few wrongly
    told may have done it, for a rig whose commands are torques, and for one that moves a joint at a time.
    """
    if load_rig(replay.rig).kind != "position":
        return None
    sets = [
        [(member, commands) for member in members]
        for members, commands in zip(replay.repeats, replay.commands, strict=True)
    ]
    usual = _usual([_responses(replay, *repeat) for repeats in sets for repeat in repeats])
    if usual < FOLLOWS:
        return None
    late = count = 0
    for repeats in sets:
        ages = np.stack([_ages(replay, *repeat, usual) for repeat in repeats])
        before, at, after = _last_clear(ages)[:, :-2], ages[:, 1:-1], ages[:, 2:]
        let_pass = (before == 0) & (at == 1) & (after >= 0)
        if len(repeats) > 1:
            let_pass &= (at <= 0).any(axis=0)
        late, count = late + int((after[let_pass] == 1).sum()), count + int(let_pass.sum())
    if not late or binomtest(late, count, BY_CHANCE, "greater").pvalue > SURE:
        return None
    return Late(late, count)


def _usual(responses: Sequence[np.ndarray]) -> float:
    """What a robot that follows its commands responds; 0 where no response is known."""
    known = np.concatenate([r[np.isfinite(r)] for r in responses]) if responses else np.zeros(0)
    return float(np.quantile(known, 0.75)) if len(known) else 0.0


def _ages(replay: Replay, member: int, commands: Commands, usual: float) -> np.ndarray:
    """(K,) how many commands ago was sent what the joints follow from each command to the next; -1: it is not clear.

    It is clear where the motion comes much nearer to what the usual response to that command is than to any response to
    another one: after a lost command a servo of limited speed stops halfway. Several joints must be asked for something
    else than before, for a single one that turns round or sticks goes anywhere.
    """
    measured, rows, lasts = _spans(replay, member, commands)
    ages = np.full(len(rows), -1)
    for k in range(int(np.searchsorted(rows[:, 1], len(measured)))):
        begin, end = rows[k]
        before = commands.target[[k - 1, max(k - 2, 0)]] if k else measured[[begin, begin]]
        targets = np.stack([commands.target[k], *before])
        asked, ways, moved = targets[0] - targets[1], targets - measured[begin], measured[end] - measured[begin]
        several = (asked**2).sum() ** 2 >= SEVERAL * (asked**4).sum()
        if not several or np.linalg.norm(asked) < STEP or lasts[k] < SHORTEST:
            continue
        response = ways @ moved / np.maximum((ways**2).sum(axis=1), 1e-12)
        away = np.linalg.norm(moved - usual * ways, axis=1)
        nearest = np.linalg.norm(moved - np.clip(response, SLOW * usual, usual)[:, None] * ways, axis=1)
        age = int(np.argmin(away))
        others = np.linalg.norm(targets - targets[age], axis=1) >= STEP
        if others.any() and away[age] < CLEAR * nearest[others].min():
            ages[k] = age
    return ages


def _last_clear(ages: np.ndarray) -> np.ndarray:
    """(R, K) each age that is not clear replaced by the last one before it that is."""
    filled = ages.copy()
    for k in range(1, ages.shape[1]):
        filled[:, k] = np.where(ages[:, k] < 0, filled[:, k - 1], ages[:, k])
    return filled


def _responses(replay: Replay, member: int, commands: Commands) -> np.ndarray:
    """(K,) which share of the way to its target the joints went until the next command; NaN of a short way."""
    measured, rows, lasts = _spans(replay, member, commands)
    found = np.full(len(commands.time), np.nan)
    for k, (begin, end) in enumerate(rows):
        if end >= len(measured) or lasts[k] < SHORTEST:
            continue
        way = commands.target[k] - measured[begin]
        if np.linalg.norm(way) >= STEP:  # NaN where nothing was measured
            found[k] = (measured[end] - measured[begin]) @ way / (way @ way)
    return found


def _spans(replay: Replay, member: int, commands: Commands) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Joint positions (T, J) in rad, first row of each command and of the next (K, 2), s between them (K,)."""
    measured = np.radians(replay.measured[member][:, replay.layout.where(JOINT)])
    ends = np.append(commands.time[1:], np.inf)
    rows = np.searchsorted(replay.time, np.stack([commands.time, ends], axis=1) - 1e-6)
    return measured, rows, ends - commands.time
