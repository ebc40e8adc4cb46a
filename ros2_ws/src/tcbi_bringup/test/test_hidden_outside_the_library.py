"""What the model's library does not have: each does to the robot what its physics says."""

import numpy as np
import pytest

from tcbi_bringup.emulated_robot import drawing as drawings
from tcbi_bringup.emulated_robot.hidden_effects import choose
from tcbi_bringup.emulated_robot.hidden_names import LIBRARY, OUTSIDE
from tcbi_bringup.emulated_robot.mechanics import Build, Scene
from tcbi_bringup.emulated_robot.physics import Physics, Specimen
from tcbi_contract.names import LEGS

SEED = 3
DRAWING = drawings.load()


def standing(name: str, settle: float = 1.5) -> Physics:
    body = Physics(Specimen.of(SEED, name, "strong"))
    body.place(Scene(), np.zeros(18))
    body.advance_to(settle)
    return body


def feet_in_hips(name: str) -> np.ndarray:
    """(6, 3) m, the feet of a robot with all joints at zero, in the trunk's frame."""
    body = Physics(Specimen.of(SEED, name, "strong"))
    feet = np.array([body.data.geom(f"{leg}_foot").xpos for leg in LEGS]) - body.data.qpos[:3]
    return feet @ body.data.body("base_link").xmat.reshape(3, 3)


def test_they_are_not_in_the_library() -> None:
    assert not set(OUTSIDE) & set(LIBRARY) and len(OUTSIDE) >= 6


def test_a_bent_shin_puts_one_foot_aside() -> None:
    told = choose("bent_leg", "strong", SEED)[2].truth
    moved = np.linalg.norm(feet_in_hips("bent_leg") - feet_in_hips("none"), axis=1)
    assert LEGS[int(moved.argmax())] == told["leg"] and np.count_nonzero(moved > 1e-6) == 1
    assert moved.max() == pytest.approx(DRAWING.tibia_length * abs(float(told["bend_rad"])), rel=0.05)  # type: ignore


def test_legs_cut_by_eye_reach_down_unequally() -> None:
    told = choose("unequal_legs", "strong", SEED)[2].truth
    longer = feet_in_hips("none")[:, 2] - feet_in_hips("unequal_legs")[:, 2]
    factors = np.array([told[f"{leg}_length_factor"] for leg in LEGS], float)
    assert longer == pytest.approx((factors - 1) * DRAWING.tibia_length * np.cos(DRAWING.tibia_tilt), abs=1e-6)


def test_sticky_feet_press_on_the_ground_until_they_are_peeled_off() -> None:
    body, bare = standing("sticky_feet"), standing("none")
    held = float(body.data.sensordata[6:].sum() - bare.data.sensordata[6:].sum())
    assert held == pytest.approx(6 * choose("sticky_feet", "strong", SEED)[2].size, rel=0.05)
    body.send(np.tile([[0.0, 0.5, 0.0], [0.0, 0.0, 0.0]], (3, 1)).ravel(), 0.2)
    body.advance_to(body.time + 1.0)
    assert not body.data.xfrc_applied[[body.model.body(f"{leg}_tibia").id for leg in LEGS[::2]]].any()


def test_an_integral_term_takes_the_sag_away() -> None:
    sag = {name: np.abs(standing(name, 4.0)._angles[1::3]).mean() for name in ("none", "integrating_servo")}
    assert sag["integrating_servo"] < 0.4 * sag["none"]


def test_one_way_gears_rub_in_one_sense_only() -> None:
    gears = choose("one_way_friction", "strong", SEED)[2]
    drag = {}
    for speed in (1.0, -1.0):
        gears.reset(np.zeros(18))
        for _ in range(500):
            torque = gears.resist(np.full(18, speed), 1e-3)
        drag[speed] = abs(float(torque[0]))  # type: ignore[index]
    assert drag[1.0] == pytest.approx(gears.size, rel=0.02) and drag[-1.0] < 0.1 * drag[1.0]


def test_cogging_comes_and_goes_with_the_angle() -> None:
    body, cogging = standing("cogging", 0.0), choose("cogging", "strong", SEED)[2]
    torques = []
    for angle in np.linspace(0, 4 * cogging.PERIOD, 81):  # type: ignore[attr-defined]
        body.data.qpos[7:], body.data.qfrc_applied[:] = angle, 0.0
        cogging.act(body.model, body.data)
        torques.append(body.data.qfrc_applied[6:].copy())
    assert np.mean(torques[:-1], axis=0) == pytest.approx(0.0, abs=1e-9)
    assert np.abs(torques).max(axis=0) == pytest.approx(cogging.size, rel=0.02)


def test_a_loose_imu_lags_a_sudden_turn_then_rings_and_comes_to_rest() -> None:
    imu, g = choose("loose_imu", "strong", SEED)[2], [0.0, 0.0, 9.81]
    still = imu.mount(np.array([0.0, 0.0, 0.0, *g]), 1e-3)
    assert still == pytest.approx([0.0, 0.0, 0.0, *g])
    turning = [imu.mount(np.array([1.0, 0.0, 0.0, *g]), 1e-3)[0] for _ in range(4000)]
    assert turning[0] < 0.1 and max(turning) > 1.3 and turning[-1] == pytest.approx(1.0, abs=0.01)


def test_a_swapped_packet_wins_over_the_one_after_it() -> None:
    relay, rng = choose("swapped_packets", "strong", SEED)[2], np.random.default_rng(0)
    relay.size = 1.0
    assert relay.hear([(0, 0.1)], True, rng) == [] and relay.hear([(1, 0.1)], False, rng) == []
    assert relay.hear([(0, 0.2), (1, 0.2)], True, rng) == [(0, 0.1), (1, 0.1)]
    relay.size = 0.0
    assert relay.hear([(0, 0.3)], True, rng) == [(0, 0.3)]


def test_hooks_change_a_robot_only_through_what_they_are_given() -> None:
    for name in OUTSIDE:
        build = Build(DRAWING.damping, DRAWING.armature, [])
        choose(name, "strong", SEED)[2].attach(build, DRAWING)
        assert build.joint_damping == DRAWING.damping and build.joint_armature == DRAWING.armature
