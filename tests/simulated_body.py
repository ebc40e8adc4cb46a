"""The sim node's own physics behind the driver's wire, as a program: what two nodes publish of it must agree.

python tests/simulated_body.py LINK     # a serial port at LINK, until SIGTERM

The robot stands, held by hand, until its servos are first switched on.
"""

import signal
import sys
import threading
import time
from pathlib import Path

import numpy as np

from hexapod_driver import calibration
from tcbi_bringup.emulated_robot.body import BodyState
from tcbi_bringup.emulated_robot.firmware import Electronics
from tcbi_bringup.emulated_robot.port import PseudoTerminal, serve
from tcbi_contract.names import JOINTS
from tcbi_sim.engine import Simulator
from tcbi_sim.measurement import Scenario
from tcbi_sim.model import base_model
from tcbi_sim.sensing import add_noise

STEP_S = 0.004


class SimulatedBody:
    """A Simulator as the firmware's body, in real time; see `tcbi_bringup.emulated_robot.body.Body`."""

    def __init__(self) -> None:
        model = base_model("hexapod")
        self._simulator = Simulator(model, model.mean()[None], [Scenario("", 8.0)], threads=1, rate=1 / STEP_S)
        self._rng = np.random.default_rng(1)
        self._target, self._fresh, self._duration = np.zeros(len(JOINTS)), False, 0.0
        self._held, self._begin = True, time.monotonic()
        self._sample = self._simulator.observe()

    def write_goal(self, servo_index: int, goal_rad: float, duration_s: float, speed_rad_s: float = 0.0) -> None:
        """One joint of a synchronous write; all of them act together."""
        self._catch_up()
        self._target[servo_index], self._duration, self._fresh = goal_rad, duration_s, True

    def set_torque(self, servo_index: int, on: bool) -> None:
        """All servos are switched alike."""
        self._catch_up()
        if on and self._held:
            self._held, self._begin = False, time.monotonic() - self._simulator.time
        if not self._held:
            self._simulator.set_torque(on)

    def read(self) -> BodyState:
        """The sensors, now, with the rig's noise but without encoder steps: those are the wire's."""
        self._catch_up()
        noise = self._simulator.rig.noise
        readings = add_noise(self._sample, noise, self._rng)
        steps = noise.joint_position * self._rng.standard_normal(len(JOINTS))
        return BodyState(
            time_s=time.monotonic(),
            joint_position=self._sample.joint_position[0, -1] + steps,
            voltage=7.4,
            temperature=np.full(len(JOINTS), 30.0),
            load=np.zeros(len(JOINTS)),
            attitude=np.roll(readings.attitude[0, -1], -1),
            angular_velocity=readings.angular_velocity[0, -1],
            linear_acceleration=readings.linear_acceleration[0, -1],
            contact=readings.contact[0, -1],
        )

    def _catch_up(self) -> None:
        if self._held:
            return
        due = int((time.monotonic() - self._begin - self._simulator.time) / STEP_S)
        if due < 1:
            return
        if self._fresh:
            self._simulator.command(self._target[None], self._duration)
            self._fresh = False
        self._sample = self._simulator.advance(due * STEP_S)


def main() -> None:
    """Serve until a signal comes."""
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    electronics = Electronics(SimulatedBody(), calibration.load(""), ports=1)
    with PseudoTerminal(Path(sys.argv[1])) as terminal:
        print(terminal.path, flush=True)
        serve(electronics, [terminal], stop)


if __name__ == "__main__":
    main()
