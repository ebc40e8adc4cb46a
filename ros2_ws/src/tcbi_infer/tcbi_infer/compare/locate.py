"""Where the error lives: which joints, in which phase or condition, and how they err; ranked sentences.

Everything is computed from the residuals and the commands, for any rig: joints form the groups that the rig names, and
stance or swing exists where the rig has legs with feet.
"""

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np

from tcbi_infer.compare.body import Whole, body_findings
from tcbi_infer.compare.conditions import conditions, phases
from tcbi_infer.compare.findings import FEWEST, LEAST_BEYOND, LEAST_OVER, Finding, Moment, doubt
from tcbi_infer.compare.kinds import kind_of
from tcbi_infer.compare.signals import DEGREE, JOINT, Layout, reference
from tcbi_sim.measurement import Measurement
from tcbi_sim.rig import Rig

LEAST_SCORE = 0.02
MOMENT_S = 1.5  # s, length of a moment
ALIKE = 2  # moments of one signal in one rollout, beyond which they would show the same again


def joint_cells(rig: Rig) -> dict[str, tuple[int, ...]]:
    """Sets of joints to look at: the rig's groups, its legs where no group is the same, and each joint by itself."""
    cells = {name: tuple(rig.index(j) for j in joints) for name, joints in rig.groups.items()}
    for leg, joints in rig.legs.items():
        members = tuple(rig.index(j) for j in joints)
        if len(members) > 1 and not any(set(members) == set(known) for known in cells.values()):
            cells[leg if leg.endswith("leg") else f"{leg} leg"] = members
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
    body = body_findings(layout, residual, floor, joints.whole, joints.span)
    findings = [*(list(joints.findings(most)) or joints.everywhere()), *body]
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
        by_position = rig.kind == "position"
        self.asked = np.stack([reference(m, time) for m in measurements]) * DEGREE if by_position else None
        self.velocity = np.gradient(self.predicted, time, axis=1)
        self.cells = {"": tuple(range(len(self.names))), **joint_cells(rig)}
        each = [phases(rig, m, time, q / DEGREE) for m, q in zip(measurements, self.predicted, strict=True)]
        none = np.zeros(self.error.shape[1:], bool)
        self.masks = {"": np.ones(self.error.shape, bool)}
        self.read: set[str] = set()  # phases by a reading, which drifts with much else
        for name in dict.fromkeys(name for masks in each for name in masks):
            self.masks[name] = np.stack([masks.get(name, none) for masks in each])
        found = conditions(layout, measurements, time, predicted)
        self.whole = Whole.of(self.masks, found, self.error.shape[:2])
        for condition in found:
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
                yield dataclasses.replace(finding, statement=finding.statement + self._doubt(best, scores))
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
        def told(label: str, phase: str) -> str:
            names = tuple(self.names[j] for j in self.cells[label])
            return phase if label == best[0] and phase else f"{_who(label, names)} {phase}".strip()

        return doubt(best, scores, lambda cell: self._cell(*cell), lambda cell: told(*cell), self.read, self.valid)

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
        told_how, kind = self._told(label, phase, cell)
        statement = (
            f"{told_how}: {_degrees(here)}, {over:.1f} times the noise floor; "
            f"{'elsewhere' if phase else 'the other joints'} {_degrees(there)}, {elsewhere:.1f} times."
        )
        names = tuple(self.names[j] for j in self.cells[label])
        return Finding(statement, score, names, phase, here, there, over, kind, self._moment(cell, left))

    def everywhere(self) -> list[Finding]:
        """What all joints do all the time, where no part of it stands out; nothing within the noise."""
        if not self.valid.any():
            return []
        over = float(np.sqrt(np.mean(self.scaled[self.valid])))
        if over < LEAST_OVER:
            return []
        here = float(np.sqrt(np.mean(self.error[self.valid] ** 2)))
        told_how, kind = self._told("", "", self.valid)
        statement = (
            f"{told_how}: {_degrees(here)}, {over:.1f} times the noise floor, much alike in all parts of the motion."
        )
        moment = self._moment(self.valid, self.excess)
        return [Finding(statement, 1.0, tuple(self.names), "", here, float("nan"), over, kind, moment)]

    def _told(self, label: str, phase: str, cell: np.ndarray) -> tuple[str, str]:
        """Who does what in a cell, the beginning of a sentence, and the kind of error that it is."""
        members = list(self.cells[label])

        def rows(values: np.ndarray) -> np.ndarray:
            return values[..., members].reshape(-1, len(members)).T

        error = np.where(cell, self.error, np.nan)
        asked = None if self.asked is None else rows(self.asked)
        kind = kind_of(rows(error), rows(self.predicted), rows(self.velocity), asked)
        names = tuple(self.names[j] for j in members)
        return f"{_who(label, names)} {kind.words(len(names) > 1, phase)}", kind.name

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


def worst_moments(
    residual: np.ndarray, floor: np.ndarray, channels: np.ndarray, count: int, span: int
) -> list[tuple[int, int, int]]:
    """(rollout, first sample, channel) of the worst windows of `span` samples, apart from each other.

    Where the rollouts are too short for as many, other channels' windows at the same times make up the number.
    """
    scaled = np.nan_to_num(residual[..., channels] / floor[channels]) ** 2
    length = scaled.shape[1]
    span = min(span, length)
    total = np.cumsum(np.concatenate([np.zeros_like(scaled[:, :1]), scaled], axis=1), axis=1)
    windows = total[:, span:] - total[:, :-span] if length > span else total[:, -1:]
    moments: list[tuple[int, int, int]] = []
    apart, other = windows.copy(), windows.copy()  # for moments at other times, then for other channels at the same
    for left in (apart, other):
        while len(moments) < count and left.size and left.max() > 0:
            r, t, c = (int(i) for i in np.unravel_index(int(np.argmax(left)), left.shape))
            moments.append((r, t, int(channels[c])))
            apart[r, max(0, t - span) : t + span] = -1
            other[r, max(0, t - span) : t + span, c] = -1
            if sum(m[0] == r and m[2] == channels[c] for m in moments) == ALIKE:
                apart[r, :, c] = other[r, :, c] = -1
    return moments


def _degrees(value: float) -> str:
    """Two digits, and none that are written as powers of ten."""
    return f"{value:.0f} deg" if value >= 99.5 else f"{value:.2g} deg"
