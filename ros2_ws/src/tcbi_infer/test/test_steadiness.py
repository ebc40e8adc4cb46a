"""A robot that does not repeat itself is told, and how many of its commands seem to get lost."""

import dataclasses
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tcbi_infer.compare.replay import Replay
from tcbi_infer.compare.steadiness import Lost, overtaken, unfollowed, unsteady
from tcbi_infer.diagnose.at_random import suspected
from tcbi_infer.diagnose.evidence import EFFECT, Evidence, Misfit
from tcbi_infer.diagnose.verdict import CANNOT_TELL, NOTHING_MISSING, OUTSIDE_LIBRARY, Ruling, rule
from tcbi_policy.gaits import Gait
from tcbi_sim.engine import simulate
from tcbi_sim.measurement import Commands, Measurement, Scenario
from tcbi_sim.model import base_model

MODEL = base_model("servo_bench")
PERIOD, COUNT = 0.2, 60
UNSTEADY = "The robot does not repeat itself."


def recorded(lost: float, noise: float = 0.001) -> list[Measurement]:
    """Two repeats of two motions of the servo bench, in which each command is lost with probability `lost`."""
    rng, found = np.random.default_rng(0), []
    for motion in range(2):
        target = np.random.default_rng(10 + motion).uniform(-0.6, 0.6, (COUNT, 1))
        for repeat in range(2):
            heard = target.copy()
            for k in range(1, COUNT):
                if rng.random() < lost:
                    heard[k] = heard[k - 1]
            time = np.arange(COUNT) * PERIOD
            scenario = Scenario("bench", COUNT * PERIOD)
            out = simulate(MODEL, MODEL.mean()[None], [scenario], commands=[Commands(time, heard, PERIOD)])
            m = out.measurement(0, rollout_id=f"motion-{motion}-{repeat}")
            moved = m.joint_position + noise * rng.standard_normal(m.joint_position.shape)
            found.append(dataclasses.replace(m, commands=Commands(time, target, PERIOD), joint_position=moved))
    return found


def told(lost: float) -> tuple[Lost | None, str]:
    replay = Replay.of(MODEL, recorded(lost))
    floor = replay.noise_floor(np.zeros_like(replay.measured))
    return unfollowed(replay), unsteady(replay, floor, overtaken(replay))


@pytest.mark.parametrize("lost", [0.1, 0.25])
def test_lost_commands_show_in_what_repeats_do_not_share(lost: float) -> None:
    found, said = told(lost)
    assert found and found.low90 < lost < found.high90
    assert 0.5 * lost < found.share < 2 * lost, "a rough figure"
    assert said.startswith(UNSTEADY[:-1])
    assert f"some {100 * found.share:.0f} % of the commands (90 % interval" in said


def hexapod_recorded(hears: Callable[[np.ndarray, np.random.Generator], np.ndarray]) -> list[Measurement]:
    """Two repeats of three motions of the standing hexapod, which follows what it `hears` of (K, 18) targets."""
    model, rng, found = base_model("hexapod"), np.random.default_rng(0), []
    time = np.arange(16) * PERIOD
    for motion in range(3):
        target = np.random.default_rng(20 + motion).uniform(-0.4, 0.4, (len(time), 18))
        for repeat in range(2):
            scenario = Scenario("balance", len(time) * PERIOD)
            heard = Commands(time, hears(target, rng), PERIOD)
            m = simulate(model, model.mean()[None], [scenario], commands=[heard]).measurement(
                0, rollout_id=f"{motion}-{repeat}"
            )
            found.append(dataclasses.replace(m, commands=Commands(time, target, PERIOD)))
    return found


def swapped(target: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A quarter of the commands wait until the next one has passed."""
    heard, k = target.copy(), 1
    while k < len(target) - 1:
        waits = rng.random() < 0.25
        if waits:
            heard[k], heard[k + 1] = heard[k - 1], target[k]
        k += 1 + waits
    return heard


def lossy(target: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A quarter of the commands are lost."""
    heard = target.copy()
    for k in np.flatnonzero(rng.random(len(target) - 1) < 0.25) + 1:
        heard[k] = heard[k - 1]
    return heard


def halfway(target: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A quarter is lost, and after that a servo of limited speed comes halfway."""
    heard = lossy(target, rng)
    after = 1 + np.flatnonzero((heard[1:-1] == heard[:-2]).all(axis=1))
    heard[after + 1] = (heard[after] + target[after + 1]) / 2
    return heard


def test_commands_that_are_followed_after_the_next_is_due_come_late_and_are_not_lost() -> None:
    late = Replay.of(base_model("hexapod"), hexapod_recorded(swapped))
    found = overtaken(late)
    assert found and 2 <= found.late <= found.let_pass
    said = unsteady(late, late.noise_floor(np.zeros_like(late.measured)), found)
    assert f"Of {found.let_pass} commands that it let pass it followed {found.late} when the next one was due" in said
    lost = Replay.of(base_model("hexapod"), hexapod_recorded(lossy))
    assert overtaken(lost) is None and unfollowed(lost), "a lost command is never followed"
    assert overtaken(Replay.of(base_model("hexapod"), hexapod_recorded(halfway))) is None


def servo_positions(target: np.ndarray, rng: np.random.Generator, kind: dict[str, float]) -> np.ndarray:
    """(T, J) of first-order servos (30 ms) that ramp to what they hear: no contacts, and no code of the simulation.

    kind: `lost` and `swapped` shares of the commands, `latency` in s, the fastest `speed` in rad/s, and whether a servo
    keeps the speed that its command was `sent` with, so that it comes only halfway after a lost one.
    """
    arrivals, k = [], 0
    while k < len(target):
        waits = k < len(target) - 1 and rng.random() < kind.get("swapped", 0.0)
        if k == 0 or rng.random() >= kind.get("lost", 0.0):
            arrivals.append(((k + waits) * PERIOD + kind.get("latency", 0.0), k))
        k += 1 + waits
    step, found = 0.002, []
    x = start = goal = np.zeros(target.shape[1])
    begun, duration = 0.0, np.full(target.shape[1], PERIOD)
    for i in range(round(len(target) * PERIOD / step)):
        now = (i + 1) * step
        share = np.clip((now - begun) / duration, 0.0, 1.0)
        if arrivals and arrivals[0][0] <= now:
            k = arrivals.pop(0)[1]
            start, goal, begun = start + share * (goal - start), target[k], now
            asked = np.abs(target[k] - (target[k - 1] if k else 0.0)) / PERIOD if kind.get("sent") else np.inf
            duration = np.where(np.isinf(asked), PERIOD, np.abs(goal - start) / np.maximum(asked, 1e-3))
            duration = np.maximum(duration, np.abs(goal - start) / kind.get("speed", np.inf)) + 1e-6
            share = np.zeros(len(goal))
        x = x + step / 0.03 * (start + share * (goal - start) - x)
        if i % 10 == 9:
            found.append(x)
    return np.array(found) + 0.001 * rng.standard_normal((len(found), len(x)))


def servos(kind: dict[str, float], seed: int) -> Any:
    """What `overtaken` asks of a replay: five gaits of 2.2 s, two of them twice, as in a quick recording."""
    rng, measured, repeats, commands = np.random.default_rng(seed), [], [], []
    for gait, count in {"steps": 2, "tripod": 2, "sinus": 1, "squat": 1, "dither": 1}.items():
        target = Gait(gait).targets[:11]
        repeats.append(tuple(range(len(measured), len(measured) + count)))
        measured += [np.degrees(servo_positions(target, rng, kind)) for _ in range(count)]
        commands.append(Commands(np.arange(11) * PERIOD, target, PERIOD))
    layout = SimpleNamespace(where=lambda _: np.arange(18))
    return SimpleNamespace(
        rig="hexapod", repeats=repeats, commands=commands, measured=np.array(measured), layout=layout,
        time=0.02 * np.arange(1, len(measured[0]) + 1),
    )  # fmt: skip


@pytest.mark.parametrize(
    "kind",
    [
        {"lost": 0.25}, {"lost": 0.25, "sent": True}, {"lost": 0.1, "sent": True}, {"lost": 0.25, "speed": 0.8},
        {"lost": 0.2, "latency": 0.1}, {"lost": 0.2, "latency": 0.15}, {"lost": 0.2, "latency": 0.2},
    ],
)  # fmt: skip
def test_commands_that_are_lost_on_slow_or_late_servos_are_not_told_to_come_late(kind: dict[str, float]) -> None:
    assert [overtaken(servos(kind, seed)) for seed in range(3)] == [None] * 3


def test_swapped_commands_show_in_most_quick_recordings() -> None:
    found = [overtaken(servos({"swapped": 0.25}, seed)) for seed in range(4)]
    assert sum(late is not None for late in found) >= 3


@pytest.mark.parametrize("lost", [0.0, 0.25])
def test_of_a_single_joint_nobody_can_say_that_commands_came_late(lost: float) -> None:
    assert overtaken(Replay.of(MODEL, recorded(lost))) is None


def test_commands_that_come_late_are_outside_the_library_whatever_else_is_said() -> None:
    misfit = Misfit(1.1, {f"motion-{i}": 1.1 for i in range(5)})
    ruling = rule([], misfit, 5, misfit, unsteady=UNSTEADY, late=True)
    assert (ruling.verdict, ruling.uses) == (OUTSIDE_LIBRARY, ()) and UNSTEADY in ruling.statement
    assert rule([], misfit, 5, misfit, late=True).verdict == NOTHING_MISSING, "of a robot that repeats itself"
    one = Misfit(1.1, {"motion": 1.1})
    assert rule([], one, 1, one, unsteady=UNSTEADY, late=True).verdict == CANNOT_TELL, "of one kind of motion"
    far = Misfit(9.0, {f"motion-{i}": 9.0 for i in range(5)})
    assert rule([], far, 5, far, base_converged=False, unsteady=UNSTEADY, late=True).verdict == CANNOT_TELL


def test_copies_of_a_recording_and_repeats_that_followed_nothing_do_not_count() -> None:
    first, again, *others = recorded(0.25)
    once = unfollowed(Replay.of(MODEL, [first, again, *others]))
    copied = unfollowed(Replay.of(MODEL, [first, dataclasses.replace(first, rollout_id="copy"), again, *others]))
    assert once and copied == once
    limp = dataclasses.replace(again, joint_position=np.full_like(again.joint_position, again.joint_position[0, 0]))
    found = unfollowed(Replay.of(MODEL, [first, limp, *others]))
    assert found and found.share < 0.25, "with the limp repeat's commands every other one would seem lost"


def test_a_robot_that_repeats_itself_is_told_nothing() -> None:
    assert told(0.0) == (None, "")


def test_nothing_missing_is_not_told_of_a_robot_that_does_not_repeat_itself() -> None:
    misfit = Misfit(1.1, {f"motion-{i}": 1.1 for i in range(5)})
    assert rule([], misfit, 5, misfit).verdict == NOTHING_MISSING
    ruling = rule([], misfit, 5, misfit, unsteady=UNSTEADY)
    assert ruling == Ruling(CANNOT_TELL, (), f"These rollouts cannot tell what is missing. {UNSTEADY}")
    random = rule([], misfit, 5, misfit, unsteady=UNSTEADY, suspected=["lost_commands"])
    assert (random.verdict, random.uses) == (CANNOT_TELL, ("lost_commands",))
    assert random.statement.endswith("lost_commands would do that.")
    far = Misfit(9.0, {f"motion-{i}": 9.0 for i in range(5)})
    assert rule([], far, 5, far).verdict == rule([], far, 5, far, unsteady=UNSTEADY).verdict == OUTSIDE_LIBRARY
    held = rule([], far, 5, far, unsteady=UNSTEADY, suspected=["lost_commands"])
    assert (held.verdict, held.uses) == (CANNOT_TELL, ("lost_commands",))


def test_an_effect_is_not_told_of_it_either_but_by_name() -> None:
    damping = Evidence(
        effect="viscous_damping", use="viscous_damping", elpd_gain=9.0, elpd_se=1.0, statistic=9.0, error_before=2.0,
        error_after=1.1, parameters=(), refined=True, converged=True, accepted=True,
    )  # fmt: skip
    misfit = Misfit(2.0, {f"motion-{i}": 2.0 for i in range(6)})
    assert rule([damping], misfit, 6, misfit).verdict == EFFECT
    ruling = rule([damping], misfit, 6, misfit, unsteady=UNSTEADY)
    assert (ruling.verdict, ruling.uses) == (CANNOT_TELL, ("viscous_damping",)) and UNSTEADY in ruling.statement


def test_lost_commands_are_among_the_suspects_with_the_share_that_repeats_tell() -> None:
    replay = Replay.of(MODEL, recorded(0.25))
    found = unfollowed(replay)
    (suspect,) = suspected(MODEL, replay, ["lost_commands"], 1.1)
    (share,) = suspect.parameters
    assert found and (share.name, share.null) == ("lost_commands.share", 0.0) and share.excludes_null
    assert (share.value, share.low90, share.high90) == pytest.approx(found)
    assert not suspect.refined and not suspect.accepted
    assert suspected(MODEL, Replay.of(MODEL, recorded(0.0)), ["lost_commands"], 1.1) == []
