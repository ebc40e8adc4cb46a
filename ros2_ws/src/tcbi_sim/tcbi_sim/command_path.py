"""From commands to what the servos track: latency, lost messages, quantisation, dead band, and the linear ramp.

B simulations, J joints. A servo ramps linearly from where its ramp stands to the target. The ramp is sampled where each
physics step begins: the integrator holds it against the angle at that time, so that in a steady motion the servo is as
far behind as a real one. Sampled in the middle of the step, it would be half a step less behind, as if it were stiffer.
A command without a ramp counts in the step in which it arrives for as long as it is there: else it would wait for the
next step, and a latency would act in whole steps only, which no fit could follow.
"""

import numpy as np

from tcbi_sim.fields import CommandFields

LEAST_SHARE = 1e-4  # of a step, of which a command must be there to count: less is rounding
Ramp = float | np.ndarray  # s, of all simulations or of each, (B, 1)


class CommandPath:
    """The commands in flight and the ramp of every servo, in simulator time (s)."""

    def __init__(self, fields: CommandFields, rngs: list[np.random.Generator]):
        count, joints = fields.latency.shape
        self.fields = fields
        self._rngs = rngs
        self._from = np.zeros((count, joints))
        self._to = np.zeros((count, joints))
        self._start = np.zeros((count, joints))
        self._ramp = np.zeros((count, joints))
        self._accepted = np.zeros((count, joints))  # what the dead band compares with
        self._pending: list[tuple[np.ndarray, np.ndarray, Ramp]] = []  # (activation (B, J), target (B, J), ramp)

    def hold(self, ids: np.ndarray, target: np.ndarray, rngs: list[np.random.Generator]) -> None:
        """Stand at `target` (n, J) and forget what was in flight for these simulations."""
        for array in (self._from, self._to, self._accepted):
            array[ids] = target
        self._ramp[ids] = 0.0
        for activation, _, _ in self._pending:
            activation[ids] = np.inf
        for i, rng in zip(ids, rngs, strict=True):
            self._rngs[i] = rng

    def give(self, time: float, target: np.ndarray, ramp: Ramp) -> None:
        """Send `target` (B, J) at `time`; a row of NaN is no command for that simulation."""
        f = self.fields
        lost = np.isnan(target).any(axis=1)
        if f.quantum.any():
            with np.errstate(invalid="ignore", divide="ignore"):
                target = np.where(f.quantum > 0, np.round(target / f.quantum) * f.quantum, target)
        if f.deadband.any():
            target = np.where(np.abs(target - self._accepted) > f.deadband, target, self._accepted)
        if f.loss.any():
            for i in np.flatnonzero((f.loss > 0) & ~lost):
                lost[i] = self._rngs[i].random() < f.loss[i]
        self._accepted = np.where(lost[:, None], self._accepted, target)
        activation = np.where(lost[:, None], np.inf, time + f.latency)
        self._pending.append((activation, self._accepted.copy(), ramp))

    def references(self, moments: np.ndarray, step: float) -> np.ndarray:
        """What the servos track in each of n physics steps, (B, n, J).

        Args:
          moments: (n,) s, increasing: where the steps begin.
          step: s, how long each is.
        """
        if self._pending and not self._ramp.any() and self._stepwise():
            return self._steps(moments, step) + self.fields.offset[:, None, :]
        times = moments[None, :, None]
        out: np.ndarray | None = None  # on the ramps so far; None where the next command's ramp covers all of it
        waiting = []
        for activation, target, ramp in self._pending:
            begins = activation <= moments[-1]
            if begins.any():
                later = times >= activation[:, None, :]
                if later.all():
                    self._begin(begins, activation, target, ramp)
                    out = None
                else:
                    before = self._value(times) if out is None else out
                    self._begin(begins, activation, target, ramp)
                    out = np.where(later, self._value(times), before)
                    jump = np.where(begins & (self._ramp == 0), self._to - self._from, 0.0)
                    during, share = _in_its_step(activation, moments, step)
                    b, j = np.nonzero((jump != 0) & (share > 0))
                    out[b, during[b, j], j] += share[b, j] * jump[b, j]
            if np.any(np.isfinite(activation) & ~begins):
                waiting.append((np.where(begins, np.inf, activation), target, ramp))
        self._pending = waiting
        return (self._value(times) if out is None else out) + self.fields.offset[:, None, :]

    def _stepwise(self) -> bool:
        """Whether every command in flight acts as a step."""
        return not any(np.any(ramp) for _, _, ramp in self._pending) and bool(np.isinf(self.fields.speed).all())

    def _steps(self, moments: np.ndarray, step: float) -> np.ndarray:
        """`references` where each servo holds the newest target that has reached it: its mean over each step."""
        times = np.stack([activation for activation, _, _ in self._pending])  # (K, B, J), rising but for lost commands
        targets = np.stack([target for _, target, _ in self._pending])
        out = np.repeat(self._to[:, None, :], len(moments), axis=1)
        last = self._to.copy()
        for b, j in np.ndindex(last.shape):
            arrives = np.flatnonzero(np.isfinite(times[:, b, j]))
            at, target = times[arrives, b, j], targets[arrives, b, j]
            newest = np.searchsorted(at, moments, side="right") - 1
            given = newest >= 0
            out[b, given, j] = target[newest[given]]
            last[b, j] = out[b, -1, j]
            during, share = _in_its_step(at, moments, step)
            np.add.at(out[b, :, j], during, share * np.diff(target, prepend=self._to[b, j]))
        self._from, self._to = last.copy(), last
        waits = (np.isfinite(times) & (times > moments[-1])).any(axis=(1, 2))
        arrived = times <= moments[-1]
        self._pending = [(np.where(arrived[k], np.inf, times[k]), targets[k], 0.0) for k in np.flatnonzero(waits)]
        return out

    def _value(self, times: np.ndarray) -> np.ndarray:
        ramp = self._ramp[:, None, :]
        with np.errstate(invalid="ignore", divide="ignore"):
            share = np.clip((times - self._start[:, None, :]) / ramp, 0.0, 1.0)
        begin, end = self._from[:, None, :], self._to[:, None, :]
        return np.where(ramp > 0, begin + share * (end - begin), end)

    def _begin(self, where: np.ndarray, at: np.ndarray, target: np.ndarray, ramp: Ramp) -> None:
        start = np.where(where, at, 0.0)
        with np.errstate(invalid="ignore", divide="ignore"):
            share = np.where(self._ramp > 0, np.clip((start - self._start) / self._ramp, 0.0, 1.0), 1.0)
        now = np.where(self._ramp > 0, self._from + share * (self._to - self._from), self._to)
        self._from = np.where(where, now, self._from)
        self._to = np.where(where, target, self._to)
        self._start = np.where(where, at, self._start)
        slowest = np.abs(target - now) / self.fields.speed
        self._ramp = np.where(where, np.maximum(ramp, slowest), self._ramp)


def _in_its_step(arrival: np.ndarray, moments: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
    """The step in which each command arrives, and the share of it that is left then; none of one before the first."""
    during = np.clip(np.searchsorted(moments, arrival) - 1, 0, None)
    share = 1.0 - (arrival - moments[during]) / step
    return during, np.where((arrival > moments[0]) & (share > LEAST_SHARE), share, 0.0)
