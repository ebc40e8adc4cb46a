"""The other effects that the model's library knows too: each does to the robot what its physics says."""

import math
from functools import cache
from typing import Any

import mujoco
import numpy as np
import pytest

from tcbi_bringup.emulated_robot import character as characters
from tcbi_bringup.emulated_robot import drawing as drawings
from tcbi_bringup.emulated_robot import mechanics
from tcbi_bringup.emulated_robot.gear import GearGap
from tcbi_bringup.emulated_robot.hidden_effect import HiddenEffect
from tcbi_bringup.emulated_robot.hidden_effects import choose
from tcbi_bringup.emulated_robot.hidden_names import LIBRARY, OUTSIDE, STRENGTHS
from tcbi_bringup.emulated_robot.mechanics import Build, Scene
from tcbi_bringup.emulated_robot.physics import Physics, Specimen, ground_attitude
from tcbi_bringup.emulated_robot.rollout import roll_pitch_yaw
from tcbi_contract.names import JOINTS, LEGS

SEED = 3
DRAWING = drawings.load()
STALL = DRAWING.torque_limit


def effect(name: str, strength: str = "strong") -> HiddenEffect:
    """The effect of robot 3, attached."""
    chosen = choose(name, strength, SEED)[2]
    chosen.attach(built(), DRAWING)
    return chosen


def built() -> Build:
    return Build(DRAWING.damping, DRAWING.armature, [])


def truth(name: str) -> dict[str, Any]:
    return choose(name, "strong", SEED)[2].truth


def standing(name: str, settle: float = 1.5, scene: Scene | None = None) -> Physics:
    body = Physics(Specimen.of(SEED, name, "strong"))
    body.place(scene or Scene(), np.zeros(18))
    body.advance_to(settle)
    return body


@cache
def bare() -> Physics:
    """A standing robot with nothing hidden; only looked at."""
    return standing("none")


def still(name: str) -> mujoco.MjData:
    """The compiled robot with all joints at zero, its trunk level a metre up."""
    build = built()
    choose(name, "strong", SEED)[2].attach(build, DRAWING)
    model = mechanics.compile_model(DRAWING, characters.draw(SEED), build, Scene())
    data = mujoco.MjData(model)
    data.qpos[2] = 1.0
    mujoco.mj_forward(model, data)
    return data


def test_sticking_gears_hold_more_at_rest_than_at_speed_and_more_under_load() -> None:
    rubbing, torques = effect("stribeck_friction"), {}
    for load in (0.0, 0.2):
        for speed in (0.05, 2.0):
            rubbing.reset(np.zeros(18))
            rubbing.drive(np.full(18, load), np.zeros(18))
            for _ in range(2000):
                torque = rubbing.resist(np.full(18, speed), 1e-3)
            assert torque is not None
            torques[load, speed] = -float(torque[0])
    static, share = truth("stribeck_friction")["static_torque_n_m"], truth("stribeck_friction")["load_share"]
    assert torques[0.0, 0.05] == pytest.approx(static, rel=0.05) and torques[0.0, 2.0] < 0.01 * static
    assert torques[0.2, 2.0] == pytest.approx(0.2 * share, rel=0.05)


def test_lossy_gears_take_their_share_of_the_motors_torque_either_way() -> None:
    gears = effect("load_friction")
    for speed in (1.0, -1.0):
        gears.reset(np.zeros(18))
        for _ in range(500):
            gears.drive(np.full(18, 0.2), np.zeros(18))
            torque = gears.resist(np.full(18, speed), 1e-3)
        assert torque is not None
        assert torque[0] == pytest.approx(-np.sign(speed) * 0.2 * truth("load_friction")["lost_share"], rel=0.02)


def test_a_heavy_rotor_is_slower_to_start_under_the_same_torque() -> None:
    build = built()
    choose("rotor_inertia", "strong", SEED)[2].attach(build, DRAWING)
    gear, speed = GearGap.of(build, 1), 0.0
    leg = np.zeros(1)
    assert gear is not None
    for _ in range(200):  # one joint without damping of its own, its leg's inertia that of the drawing
        push = gear.push(np.full(1, 0.1), leg, np.full(1, speed), 1e-4)
        speed += 1e-4 * float(push[0]) / build.joint_armature
        leg = leg + 1e-4 * speed
    inertia = DRAWING.armature + truth("rotor_inertia")["inertia_kg_m2"]
    assert speed == pytest.approx(0.1 * 0.02 / inertia, rel=0.15)


def test_springy_links_bend_in_proportion_to_the_torque() -> None:
    body = standing("link_flexibility")
    bent = (body.shaft - body._angles)[1::3]
    assert bent == pytest.approx(truth("link_flexibility")["compliance_rad_per_n_m"] * body._torque[1::3], rel=0.1)


def test_one_odd_servo_has_another_stiffness() -> None:
    told = truth("gain_scatter")
    ratio = standing("gain_scatter", 0.0)._gain / standing("none", 0.0)._gain
    odd = np.flatnonzero(np.abs(ratio - 1) > 1e-9)
    assert [JOINTS[i] for i in odd] == [told["joint"]] and ratio[odd[0]] == pytest.approx(told["stiffness_factor"])


def test_a_slipped_horn_turns_the_link_behind_it_by_the_true_angle_less_the_reading() -> None:
    told, slipped, straight = truth("joint_offset"), still("joint_offset"), still("none")
    straight.joint(told["joint"]).qpos[:] = told["offset_rad"]
    mujoco.mj_forward(straight.model, straight)
    assert slipped.geom_xpos == pytest.approx(straight.geom_xpos, abs=1e-9)


def test_a_battery_sags_slowly_to_its_drop_and_recovers() -> None:
    battery, stalled = effect("battery_sag"), np.full(18, STALL)
    first = battery.drive(stalled.copy(), np.zeros(18))[0] / STALL
    for _ in range(5000):
        last = battery.drive(stalled.copy(), np.zeros(18))[0] / STALL
    drop = truth("battery_sag")["drop_at_stall"]
    assert 1 - 0.25 * drop < first < 1 and last == pytest.approx(1 - drop * last, rel=0.01)
    assert battery.supply() == pytest.approx(last)
    for _ in range(3000):
        battery.drive(np.zeros(18), np.zeros(18))
    assert battery.supply() == pytest.approx(1.0, abs=0.01)


def test_loaded_motors_fade_and_idle_ones_do_not_even_when_the_robot_is_placed_again() -> None:
    hot, asked = effect("thermal_fading"), np.where(np.arange(18) < 9, STALL, 0.01)
    for _ in range(1000):
        given = hot.drive(asked.copy(), np.zeros(18))
    lost = truth("thermal_fading")["loss_per_s_at_stall"]
    assert given[0] / STALL == pytest.approx(1 / (1 + lost), rel=0.03) and given[-1] == pytest.approx(0.01, rel=1e-3)
    hot.reset(np.zeros(18))
    assert hot.drive(asked.copy(), np.zeros(18))[0] < STALL / (1 + 0.9 * lost)


def test_limited_current_follows_small_demands_and_cuts_large_ones() -> None:
    limit = truth("torque_saturation")["remaining_torque_share"] * STALL
    asked = np.array([0.3 * limit, -0.3 * limit, 4 * limit, -4 * limit])
    given = effect("torque_saturation").drive(asked.copy(), np.zeros(4))
    assert given[:2] == pytest.approx(asked[:2], rel=1e-3) and np.abs(given[2:]) == pytest.approx(limit, rel=0.01)


def test_back_emf_uses_the_torque_up_at_the_speed_without_load_and_leaves_braking_alone() -> None:
    motors, fastest = effect("speed_limit"), 1 / truth("speed_limit")["slowness_s_per_rad"]
    speed = np.linspace(-fastest, fastest, 18)
    for _ in range(20):
        torque = motors.drive(np.full(18, STALL), speed)
    assert torque == pytest.approx(STALL * np.minimum(1 - speed / fastest, 1), abs=1e-4)
    for _ in range(20):
        held = motors.drive(np.full(18, 0.1 * STALL), 0.5 * speed)
    assert held == pytest.approx(0.1 * STALL, rel=1e-3)


def test_a_lossy_radio_loses_its_share_of_packets_in_bursts() -> None:
    radio, rng = effect("lost_commands"), np.random.default_rng(0)
    lost = np.array([math.isinf(radio.bus_delay(rng)) for _ in range(20000)])
    bursts = np.count_nonzero(lost[1:] & ~lost[:-1])
    assert lost.mean() == pytest.approx(truth("lost_commands")["lost_share"], rel=0.08)
    assert lost.sum() / bursts == pytest.approx(1.5, rel=0.08)


def test_a_lost_packet_leaves_every_servo_where_it_was_going() -> None:
    body = standing("lost_commands", 0.1)
    body._effect.bus_delay = lambda rng: math.inf  # type: ignore[method-assign]
    body.send(np.full(18, 0.2), 0.1)
    body.advance_to(0.5)
    assert not body.servos.goal.any()


def test_dull_servos_ignore_small_changes_of_their_goal() -> None:
    servos, band, rng = effect("command_deadband"), truth("command_deadband")["band_rad"], np.random.default_rng(0)
    servos.reset(np.zeros(18))
    assert servos.hear([(0, 0.7 * band), (1, -1.5 * band)], True, rng) == [(1, -1.5 * band)]
    assert servos.hear([(0, 1.4 * band), (1, -1.2 * band)], True, rng) == [(0, 1.4 * band)]


def test_stale_readings_show_the_past_under_the_present_stamp() -> None:
    late, prompt = standing("sensor_latency", 0.5), standing("none", 0.5)
    lag = []
    for body in (late, prompt):
        body.send(np.tile([0.4, 0.0, 0.0], 6), 0.2)
        times, angles = [], []
        while body.time < 0.9:
            body.advance_to(body.time + 0.02)
            sample = body.read()
            times.append(sample.time)
            angles.append(sample.joint_position[::3].mean())
        lag.append(np.interp(0.2, angles[:15], times[:15]))
    assert lag[0] - lag[1] == pytest.approx(truth("sensor_latency")["latency_s"], abs=0.003)


def test_an_askew_board_shows_a_lean_that_is_not_there() -> None:
    told, read = truth("imu_tilt"), standing("imu_tilt").read()
    roll, pitch, _ = np.subtract(roll_pitch_yaw(read.attitude), roll_pitch_yaw(bare().read().attitude))
    assert (roll, pitch) == pytest.approx((told["roll_rad"], told["pitch_rad"]), abs=0.004)
    lean = np.arctan2(read.linear_acceleration[1], read.linear_acceleration[2])
    assert lean == pytest.approx(told["roll_rad"], abs=0.02)


def test_a_biased_gyroscope_turns_at_rest_while_the_attitude_stands() -> None:
    body, told = standing("gyro_bias"), truth("gyro_bias")
    rates = np.mean([body.read().angular_velocity for _ in range(400)], axis=0)
    assert rates == pytest.approx([told[f"{a}_rad_s"] for a in "xyz"], abs=0.12 * float(np.linalg.norm(rates)) + 2e-3)
    assert body.read().attitude == pytest.approx(bare().read().attitude, abs=2e-3)


def test_feet_sink_into_foam() -> None:
    assert standing("soft_ground").true_position()[2] < bare().true_position()[2] - 0.001


def test_feet_beyond_the_edge_of_the_oil_have_less_grip() -> None:
    body, told = standing("slippery_ground", 0.3), truth("slippery_ground")
    feet = [body.model.geom(f"{leg}_foot").id for leg in LEGS]
    beyond = body.data.geom_xpos[feet, :2] @ [math.cos(told["heading_rad"]), math.sin(told["heading_rad"])]
    grip = body.model.geom_friction[feet, 0] / body.model.geom("ground").friction[0]
    assert grip[beyond > told["begin_m"] + 0.011] == pytest.approx(told["grip"])
    assert grip[beyond < told["begin_m"] - 0.011] == pytest.approx(1.0) and np.ptp(grip) > 0.3


def test_the_board_stands_steeper_than_noted() -> None:
    bare, told = standing("none", 0.0), truth("slope_error")
    roll, pitch, _ = roll_pitch_yaw(ground_attitude(standing("slope_error", 0.0).scene))
    roll0, pitch0, _ = roll_pitch_yaw(ground_attitude(bare.scene))
    assert (roll - roll0, pitch - pitch0) == pytest.approx((told["roll_rad"], told["pitch_rad"]), abs=1e-9)


def test_a_taut_cable_draws_the_trunk_to_its_side() -> None:
    told = truth("cable_pull")
    moved = (standing("cable_pull").data.qpos - bare().data.qpos)[:2]
    assert moved @ [told["x_n"], told["y_n"]] > 0.9 * np.hypot(*moved) * np.hypot(told["x_n"], told["y_n"])
    assert np.hypot(*moved) > 1e-3


def test_two_effects_in_one_robot_do_both() -> None:
    body = standing("backlash+payload")
    assert set(body.specimen.truth()["effect"]) == {"backlash", "payload"}  # type: ignore[call-overload]
    gap = choose("backlash+payload", "strong", SEED)[2].truth["backlash"]["gap_rad"]  # type: ignore[index]
    assert np.abs(body.shaft - body._angles)[1::3].min() > 0.45 * gap
    assert body.data.sensordata[6:].sum() > bare().data.sensordata[6:].sum() + 1.0


@pytest.mark.parametrize("strength", STRENGTHS)
def test_a_robot_with_everything_at_once_moves_without_breaking(strength: str) -> None:
    body = Physics(Specimen.of(SEED, "+".join((*LIBRARY, *OUTSIDE)), strength))
    body.place(Scene(slope_roll=0.1), np.zeros(18))
    rng = np.random.default_rng(0)
    while body.time < 1.6:
        body.send(rng.uniform(-0.5, 0.5, 18), 0.2)
        body.advance_to(body.time + 0.2)
        sample = body.read()
        assert np.abs(sample.joint_position).max() < 1.0 and np.isfinite(sample.attitude).all()
    assert np.abs(body.data.qvel).max() < 60.0 and body.true_position()[2] > 0.0
