"""How far one inference goes on many machines: a simulation of driver, network link, workers and their losses.

./tcbi python bench/scale_model.py                              # 10 to 10,000 cores with the measured costs
./tcbi python bench/scale_model.py --set loss_every_h=20        # each machine fails every 20 h
./tcbi python bench/scale_model.py --set bytes_back=108000      # whole trajectories travel back

Discrete events. The driver is one thread: it hands a chunk out (`hand_out_s`), takes its result (`take_s`, and
`take_s_per_byte`), and weighs all particles after each generation (`weigh_s` for a thousand, growing by `weigh_power`).
What all chunks of a generation share goes to each machine over the driver's network link, one after the other; results
queue for the same link. Before the last generation a few particles are simulated with short steps, and after it some
are looked at in time: for the slowest of these the driver waits. A chunk has `chunk_s` of its own besides its steps,
and takes longer by a factor drawn from a log-normal distribution (`straggling`) and by its machine's (`slow_share` of
them are half as fast). Machines are lost at random; the chunks on them begin anew elsewhere after Ray has noticed
(`notice_s`). The defaults are what bench/scale.py measured (docs/scale.md) or, from `bandwidth` on, assumed.
"""

import argparse
import dataclasses
import heapq
import json
import math
import sys
from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np

from tcbi_bringup.commands.bench import figure

CORES = (10, 30, 100, 300, 1000, 3000, 10_000)
QUEUED = 2  # chunks given out for each core
EACH = 4  # chunks a core and generation, unless they become too large or too small


@dataclass(frozen=True)
class Case:
    """One inference: what is to be done, what it costs, who does it."""

    rollouts: float = 1e6
    per_particle: float = 20  # rollouts
    generations: float = 6
    rollout_s: float = 9.0  # 8 s, and 1 s of settling
    timestep: float = 0.005
    finer: float = 6  # particles that are simulated once more before the last generation, with so many times the steps
    finer_steps: float = 2.5
    check: float = 48  # particles of the posterior that are looked at in time, and those close to the best of them then
    close: float = 24
    least_steps: float = 10_000
    most_steps: float = 200_000
    # measured
    step_s: float = 29.2e-6  # of one core
    chunk_s: float = 0.012  # of one core, for each chunk
    hand_out_s: float = 0.48e-3  # of the driver, for each chunk
    take_s: float = 0.48e-3
    take_s_per_byte: float = 0.7e-9
    bytes_back: float = 4900.0  # for each rollout
    shared_bytes: float = 6e6  # of a generation, to each machine
    weigh_s: float = 0.30  # of the driver, for a thousand particles, as follows from 6400 and 12,800; 0.8 was measured
    weigh_power: float = 1.14  # of the number of particles
    # assumed
    bandwidth: float = 1.25e9  # bytes/s of the driver's network link
    cores_each: float = 32  # of a machine
    straggling: float = 0.1  # standard deviation of the logarithm of a chunk's time
    slow_share: float = 0.02  # of the machines, half as fast
    loss_every_h: float = 1000.0  # for each machine
    back_after_s: float = 300.0  # a lost machine is replaced
    notice_s: float = 30.0  # until Ray takes a machine for lost


@dataclass(frozen=True)
class Outcome:
    """How it went."""

    wall_s: float
    efficiency: float  # share of the cores' time that is steps
    driver: float  # share of its time that the driver was busy with chunks
    link: float  # and its network link
    weighing: float  # share of the time that all wait for the weighing
    losses: int  # machines
    again: int  # chunks worked on once more


def run(case: Case, cores: int, seed: int = 0) -> Outcome:
    """One inference on so many cores."""
    rng = np.random.default_rng([seed, cores])
    world = World(case, cores, rng)
    particles = max(1, round(case.rollouts / case.per_particle / case.generations))
    weighing = 0.0
    for generation in range(round(case.generations)):
        if generation == round(case.generations) - 1:
            world.generation(round(case.finer), case.finer_steps)
        world.generation(particles)
        done = particles * (generation + 1)
        weigh = case.weigh_s * (done / 1000) ** case.weigh_power
        world.now += weigh
        weighing += weigh
    for looked_at in (case.check, case.close):
        world.generation(round(looked_at))
    steps = particles * case.generations * case.per_particle * case.rollout_s / case.timestep
    return Outcome(
        world.now,
        steps * case.step_s / (world.now * cores),
        world.driver_busy / world.now,
        world.link_busy / world.now,
        weighing / world.now,
        world.losses,
        world.again,
    )


class World:
    """Machines, link and driver, and the time."""

    def __init__(self, case: Case, cores: int, rng: np.random.Generator):
        self.case, self.cores, self.rng = case, cores, rng
        self.each = round(min(case.cores_each, cores))
        count = math.ceil(cores / self.each)
        self.speed = np.where(rng.random(count) < case.slow_share, 2.0, 1.0)  # times as long
        self.now = self.link_free = 0.0
        self.driver_busy = self.link_busy = 0.0
        self.losses = self.again = 0

    def generation(self, particles: int, finer: float = 1.0) -> None:
        """Hand out the chunks of so many particles, with so many times the usual steps, and wait for all of them."""
        if not particles:
            return
        case = self.case
        steps = finer * case.per_particle * case.rollout_s / case.timestep  # of a particle
        most = max(1, int(case.most_steps / steps))
        least = max(1, round(case.least_steps / steps))
        number = max(min(EACH * self.cores, particles // least), -(-particles // most), 1)
        size = -(-particles // number)
        number = -(-particles // size)
        self.work_s = case.chunk_s + size * steps * case.step_s
        self.bytes = size * case.per_particle * case.bytes_back
        self._events: list[tuple[float, int, str, Any]] = []
        self._order = 0
        self.free = [k % len(self.speed) for k in range(self.cores)]  # a machine's number for each idle core
        self.lost_until = np.zeros(len(self.speed))
        self.epoch = np.zeros(len(self.speed), int)
        self.queue: deque[int] = deque()  # chunks that wait for a core
        self.at: dict[int, int] = {}  # chunk -> its machine
        copy = case.shared_bytes / case.bandwidth
        self.ready = self.now + copy * np.arange(1, len(self.speed) + 1)  # when a machine has what all chunks share
        self.link_free = max(self.link_free, float(self.ready[-1]))
        self.link_busy += copy * len(self.speed)
        self._lose_machines()
        given, out, taken = 0, 0, 0
        arrived: list[int] = []
        driver_free = self.now
        while taken < number:
            if arrived and driver_free <= self.now:
                arrived.pop()
                busy = case.take_s + case.take_s_per_byte * self.bytes
                taken, out = taken + 1, out - 1
            elif given < number and out < QUEUED * self.cores and driver_free <= self.now:
                busy = case.hand_out_s
                self._at(self.now + busy, "queued", given)
                given, out = given + 1, out + 1
            else:
                time, _, kind, what = heapq.heappop(self._events)
                self.now = max(self.now, time)
                if kind == "arrived":
                    arrived.append(what)
                else:
                    getattr(self, f"_{kind}")(what)
                continue
            driver_free = self.now + busy
            self.driver_busy += busy
            self._at(driver_free, "driver", None)
        self.now = max(self.now, driver_free)

    def _at(self, time: float, kind: str, what: Any) -> None:
        self._order += 1
        heapq.heappush(self._events, (time, self._order, kind, what))

    def _driver(self, _: None) -> None:
        """It has time again: the loop looks what there is to do."""

    def _queued(self, chunk: int) -> None:
        self.queue.append(chunk)
        self._begin()

    def _begin(self) -> None:
        while self.queue and self.free:
            machine = self.free.pop(int(self.rng.integers(len(self.free))))
            if self.lost_until[machine] > self.now:
                continue  # its cores come back with it
            chunk = self.queue.popleft()
            self.at[chunk] = machine
            factor = math.exp(self.case.straggling * self.rng.standard_normal()) * self.speed[machine]
            begin = max(self.now, float(self.ready[machine]))
            self._at(begin + factor * self.work_s, "finished", (chunk, machine, self.epoch[machine]))

    def _finished(self, what: tuple[int, int, int]) -> None:
        chunk, machine, epoch = what
        if self.epoch[machine] != epoch:
            return  # it was lost in the meantime
        del self.at[chunk]
        self.free.append(machine)
        begin = max(self.now, self.link_free)
        self.link_free = begin + self.bytes / self.case.bandwidth
        self.link_busy += self.bytes / self.case.bandwidth
        self._at(self.link_free, "arrived", chunk)
        self._begin()

    def _lose_machines(self) -> None:
        mean = self.case.loss_every_h * 3600
        for machine in range(len(self.speed)):
            self._at(self.now + self.rng.exponential(mean), "lost", machine)

    def _lost(self, machine: int) -> None:
        self.losses += 1
        self.epoch[machine] += 1
        self.lost_until[machine] = self.now + self.case.back_after_s
        for chunk in [c for c, m in self.at.items() if m == machine]:
            del self.at[chunk]
            self.again += 1
            self._at(self.now + self.case.notice_s, "queued", chunk)
        self.free = [m for m in self.free if m != machine]
        self._at(self.lost_until[machine], "back", machine)

    def _back(self, machine: int) -> None:
        cores = sum(1 for k in range(self.cores) if k % len(self.speed) == machine)
        self.free += [machine] * cores
        self._begin()
        self._at(self.now + self.rng.exponential(self.case.loss_every_h * 3600), "lost", machine)


def main() -> int:
    """Print what the simulation gives from 10 to 10,000 cores."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a tenth of the rollouts, up to 1000 cores")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="of the case; may be repeated")
    options = parser.parse_args()
    known = {f.name for f in dataclasses.fields(Case)}
    pairs = [word.partition("=") for word in options.set]
    for name, _, _ in pairs:
        if name not in known:
            parser.error(f"unknown name {name!r}; there are {', '.join(sorted(known))}")
    case = Case(**{**({"rollouts": 1e5} if options.quick else {}), **{n: float(v) for n, _, v in pairs}})
    figures = []
    for cores in CORES[: 5 if options.quick else None]:
        o = run(case, cores)
        print(f"{cores:6d} cores: {o}", file=sys.stderr)
        figures += [
            figure(f"{cores} cores: wall time", o.wall_s, "s"),
            figure(f"{cores} cores: share of their time that is steps", o.efficiency, "1"),
            figure(f"{cores} cores: driver busy with chunks", o.driver, "1"),
            figure(f"{cores} cores: network link busy", o.link, "1"),
            figure(f"{cores} cores: everybody waits for the weighing", o.weighing, "1"),
            figure(f"{cores} cores: chunks worked on again", o.again, "1"),
        ]
    print(json.dumps({"name": "scale_model", "case": dataclasses.asdict(case), "figures": figures}, indent=2))
    return 0


if __name__ == "__main__":
    sys.exit(main())
