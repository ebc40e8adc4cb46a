"""Where the error lives: which joints, in which phase or condition, and how they err; ranked sentences.

Everything is computed from the residuals and the commands, for any rig: joints form the groups that the rig names, and
stance or swing exists where the rig has legs with feet.
"""

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np

from tcbi_infer.compare.conditions import conditions, phases
from tcbi_infer.compare.kinds import OFFSET, SCATTER, kind_of
from tcbi_infer.compare.signals import ATTITUDE, DEGREE, JOINT, RATE, Layout, reference
from tcbi_sim.measurement import Measurement
from tcbi_sim.rig import Rig

FEWEST = 25  # samples that a cell needs
LEAST_SCORE = 0.02
LEAST_OVER, LEAST_BEYOND = 1.5, 1.15  # times the noise floor, times the error elsewhere, that are worth a sentence
MOMENT_S = 1.5  # s, length of a moment
AS_GOOD, SAME_SAMPLES = 0.8, 0.6  # of a cell's score, and shared by both, from which another cell may be meant as well
WHOLE = 0.95  # share of a rollout's samples that counts as all of it


@dataclasses.dataclass(frozen=True)
class Moment:
    """A stretch of one channel, from sample `first` on; `inside` (span,) is where the phase holds."""

    rollout: int
    first: int
    channel: int
    inside: np.ndarray


@dataclasses.dataclass(frozen=True)
class Finding:
    """One place where the error lives.

    Attributes:
      statement: a sentence for people, computed from the data.
      score: share of the excess squared error that lies there, beyond the cell's share of the samples, 0..1; what a
        better finding covers is not counted again.
      channels: names of the channels concerned.
      phase: the phase or condition, "" for all samples.
      rms: error there, in the channels' unit; `elsewhere` the same outside the cell and of better findings.
      kind: lag, offset, droop, gain, hysteresis or scatter.
      moment: the stretch that shows it best; None of the body.
    """

    statement: str
    score: float
    channels: tuple[str, ...]
    phase: str
    rms: float
    elsewhere: float
    over_floor: float
    kind: str = SCATTER
    moment: Moment | None = None


def joint_cells(rig: Rig) -> dict[str, tuple[int, ...]]:
    """Sets of joints to look at: the rig's named groups, and each joint by itself."""
    cells = {name: tuple(rig.index(j) for j in joints) for name, joints in rig.groups.items()}
    cells |= {name: (j,) for j, name in enumerate(rig.joint_names)}
    return {name: joints for name, joints in cells.items() if len(joints) < len(rig.joint_names)}


def locate(
    rig: Rig,
    layout: Layout,
    measurements: Sequence[Measurement],
    time: np.ndarray,
    residual: np.ndarray,
    predicted: np.ndarray,
    floor: np.ndarray,
    most: int = 6,
) -> list[Finding]:
    """Ranked places where the error lives; each covers what those before it have not.

    Args:
      rig: the robot.
      layout: the channels.
      measurements: (R) rollouts, on the common grid.
      time: (T,) s.
      residual: (R, T, C) measured less predicted, NaN where missing.
      predicted: (R, T, C).
      floor: (C,) noise floor.
      most: sentences at most.
    """
    joints = _Joints(rig, layout, measurements, time, residual, predicted, floor)
    findings = [*joints.findings(most), *_body_findings(layout, residual, floor)]
    return sorted(findings, key=lambda f: -f.score)[:most]


class _Joints:
    """The joints' errors, cell by cell."""

    def __init__(
        self,
        rig: Rig,
        layout: Layout,
        measurements: Sequence[Measurement],
        time: np.ndarray,
        residual: np.ndarray,
        predicted: np.ndarray,
        floor: np.ndarray,
    ) -> None:
        self.index = layout.where(JOINT)
        self.names, self.span = layout.joint_names, min(max(2, round(MOMENT_S * layout.rate)), len(time))
        self.error, self.predicted = residual[..., self.index], predicted[..., self.index]
        self.valid = np.isfinite(self.error)
        self.scaled = np.where(self.valid, (np.nan_to_num(self.error) / floor[self.index]) ** 2, 0.0)
        self.excess = np.maximum(self.scaled - 1.0, 0.0) * self.valid
        self.asked = np.stack([reference(m, time) for m in measurements]) * DEGREE
        self.velocity = np.gradient(self.predicted, time, axis=1)
        self.cells = {"": tuple(range(len(self.names))), **joint_cells(rig)}
        each = [phases(rig, m, time) for m in measurements]
        none = np.zeros(self.error.shape[1:], bool)
        self.masks = {"": np.ones(self.error.shape, bool)}
        self.read: set[str] = set()  # phases by a reading, which drifts with much else
        for name in dict.fromkeys(name for masks in each for name in masks):
            self.masks[name] = np.stack([masks.get(name, none) for masks in each])
        for condition in conditions(layout, measurements, time, predicted):
            parts = condition.parts()
            self.masks |= parts
            self.read |= set(parts) if condition.reading else set()
        self.count = {name: (mask & self.valid).sum(axis=(0, 1)) for name, mask in self.masks.items()}

    def findings(self, most: int) -> Iterator[Finding]:
        """The best cell, then the best of what it leaves, and so on."""
        total, left = float(self.excess.sum()), self.excess.copy()
        seen: set[tuple[str, str]] = set()
        told, found = np.zeros_like(self.valid), 0
        while total > 0 and found < most and len(seen) < 4 * most:
            scores = {cell: score for cell, score in self._scores(left, total) if cell not in seen}
            best = max(scores, key=lambda cell: scores[cell], default=None)
            if best is None or scores[best] < LEAST_SCORE:
                return
            seen.add(best)
            finding = self._finding(*best, scores[best], left, told)
            if finding is not None:
                doubt = self._doubt(best, scores)
                yield dataclasses.replace(finding, statement=finding.statement + doubt)
                found += 1
                told |= self._cell(*best)
                left[told] = 0.0

    def _scores(self, left: np.ndarray, total: float) -> Iterator[tuple[tuple[str, str], float]]:
        samples, rest = int(self.valid.sum()), float(left.sum() / total)
        for phase, mask in self.masks.items():
            here = np.where(mask, left, 0.0).sum(axis=(0, 1))
            for label, members in self.cells.items():
                index = list(members)
                count = int(self.count[phase][index].sum())
                if (label or phase) and FEWEST <= count <= samples - FEWEST:
                    yield (label, phase), float(here[index].sum() / total - count / samples * rest)

    def _doubt(self, best: tuple[str, str], scores: dict[tuple[str, str], float]) -> str:
        """What else may be meant where a reading is concerned: nearly the same samples, which err nearly as much."""
        here, doubts = self._cell(*best), []
        for cell in sorted(scores, key=lambda cell: -scores[cell]):
            if cell[1] == best[1] or not {cell[1], best[1]} & self.read or scores[cell] < AS_GOOD * scores[best]:
                continue
            there = self._cell(*cell)
            if np.sum(here & there) >= SAME_SAMPLES * np.sum(here | there):
                names = tuple(self.names[j] for j in self.cells[cell[0]])
                other = cell[1] if cell[0] == best[0] and cell[1] else f"{_who(cell[0], names)} {cell[1]}".strip()
                doubts.append(
                    f" Nearly the same samples ({other}) err as much: these recordings cannot tell which is behind it."
                )
                break
        if best[1] in self.read:
            total = np.maximum(self.valid.sum(axis=(1, 2)), 1)
            share = (self.masks[best[1]] & self.valid).sum(axis=(1, 2)) / total
            if np.all((share > WHOLE) | (share < 1 - WHOLE)):
                doubts.append(" These are whole rollouts: whatever else differed between them may be behind it.")
        return "".join(doubts)

    def _cell(self, label: str, phase: str) -> np.ndarray:
        """(R, T, J) bool."""
        members = np.zeros(len(self.names), bool)
        members[list(self.cells[label])] = True
        return self.masks[phase] & members & self.valid

    def _finding(self, label: str, phase: str, score: float, left: np.ndarray, told: np.ndarray) -> Finding | None:
        cell = self._cell(label, phase)
        outside = self.valid & ~cell & ~told
        if not outside.any():
            return None
        here, there = (float(np.sqrt(np.mean(self.error[part] ** 2))) for part in (cell, outside))
        over, elsewhere = (float(np.sqrt(np.mean(self.scaled[part]))) for part in (cell, outside))
        if over < LEAST_OVER or over < LEAST_BEYOND * elsewhere:
            return None
        members = list(self.cells[label])

        def rows(values: np.ndarray) -> np.ndarray:
            return values[..., members].reshape(-1, len(members)).T

        error = np.where(cell, self.error, np.nan)
        kind = kind_of(rows(error), rows(self.predicted), rows(self.velocity), rows(self.asked))
        names = tuple(self.names[j] for j in members)
        statement = (
            f"{_who(label, names)} {kind.words(len(names) > 1, phase)}: {here:.2g} deg, {over:.1f} "
            f"times the noise floor; elsewhere {there:.2g} deg, {elsewhere:.1f} times."
        )
        moment = self._moment(cell, left)
        return Finding(statement, score, names, phase, here, there, over, kind.name, moment)

    def _moment(self, cell: np.ndarray, left: np.ndarray) -> Moment:
        """The stretch of one joint that holds most of a cell's excess error."""
        worst = np.where(cell, left, 0.0)
        total = np.cumsum(np.concatenate([np.zeros_like(worst[:, :1]), worst], axis=1), axis=1)
        windows = total[:, self.span :] - total[:, : -self.span]
        r, t, j = (int(i) for i in np.unravel_index(int(np.argmax(windows)), windows.shape))
        return Moment(r, t, int(self.index[j]), cell[r, t : t + self.span, j])


def _who(label: str, names: Sequence[str]) -> str:
    """The subject of a sentence; plural unless it is a single joint."""
    if len(names) == 1:
        return names[0]
    if not label:
        return "All joints"
    return f"The joints of the {label}" if label.endswith("leg") else f"The {label}"


def _body_findings(layout: Layout, residual: np.ndarray, floor: np.ndarray) -> list[Finding]:
    """Body signals stand apart from joints: tilt that joints do not explain points at sensors, ground or mass."""
    joints = layout.where(JOINT)
    over_joint = _over(residual, floor, joints)
    findings = []
    for group, noun in ((ATTITUDE, "body attitude"), (RATE, "body rates")):
        index = layout.where(group)
        if not len(index) or not np.isfinite(residual[..., index]).any():
            continue
        over = _over(residual, floor, index)
        if over < 1.5 or over < 1.15 * over_joint:
            continue
        rms = float(np.sqrt(np.nanmean(residual[..., index] ** 2)))
        mean = np.nanmean(residual[..., index], axis=(0, 1))
        constant = float(np.sum(mean**2) / np.sum(np.nanmean(residual[..., index] ** 2, axis=(0, 1))))
        kind = ", mostly a constant offset" if constant > 0.6 else ""
        text = (
            f"The {noun} departs from the prediction by {rms:.2f} {group.unit}, {over:.1f} times the noise floor"
            f"{kind}, while the joints stand at {over_joint:.1f} times theirs."
        )
        score = float(min(1.0, 1.0 - over_joint**2 / over**2))
        names = tuple(layout.channels[i].name for i in index)
        shape = OFFSET if constant > 0.6 else SCATTER
        findings.append(Finding(text, score, names, "", rms, float("nan"), over, shape))
    return findings


def _over(residual: np.ndarray, floor: np.ndarray, index: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean((residual[..., index] / floor[index]) ** 2)))


def worst_moments(
    residual: np.ndarray, floor: np.ndarray, joints: np.ndarray, count: int, span: int
) -> list[tuple[int, int, int]]:
    """(rollout, first sample, channel) of the worst windows of `span` samples, apart from each other."""
    scaled = np.nan_to_num(residual[..., joints] / floor[joints]) ** 2
    length = scaled.shape[1]
    span = min(span, length)
    total = np.cumsum(np.concatenate([np.zeros_like(scaled[:, :1]), scaled], axis=1), axis=1)
    windows = total[:, span:] - total[:, :-span] if length > span else total[:, -1:]
    moments: list[tuple[int, int, int]] = []
    windows = windows.copy()
    while len(moments) < count and windows.size and windows.max() > 0:
        r, t, c = np.unravel_index(int(np.argmax(windows)), windows.shape)
        moments.append((int(r), int(t), int(joints[c])))
        windows[r, :, c] = -1
        windows[r, max(0, t - span) : t + span, :] = -1
    return moments
