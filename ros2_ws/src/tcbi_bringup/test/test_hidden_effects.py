"""The effects that a robot's number draws from change the motion the way their physics says; `none` changes nothing."""

from functools import cache
from typing import Any

import numpy as np
import pytest

from tcbi_bringup.emulated_robot import drawing as drawings
from tcbi_bringup.emulated_robot.errors import EmulatedRobotError
from tcbi_bringup.emulated_robot.gear import GearGap
from tcbi_bringup.emulated_robot.hidden.friction import SlippingTeeth
from tcbi_bringup.emulated_robot.hidden_effects import EFFECTS, choose
from tcbi_bringup.emulated_robot.hidden_names import DRAWN, LIBRARY, NAMES
from tcbi_bringup.emulated_robot.mechanics import GRAVITY, Build, Scene
from tcbi_bringup.emulated_robot.physics import Physics, Specimen
from tcbi_bringup.emulated_robot.rollout import EmulatedRobot, Recording, Script, roll_pitch_yaw
from tcbi_contract.names import LEGS

SEED = 3
COXAE = slice(0, 18, 3)


def standing(hidden: str, strength: str = "strong", settle: float = 2.0) -> Physics:
    """A robot after `settle` seconds on flat ground."""
    body = Physics(Specimen.of(SEED, hidden, strength))
    body.place(Scene(), np.zeros(18))
    body.advance_to(settle)
    return body


@cache
def swing(hidden: str, strength: str = "strong", trial: int = 0) -> Recording:
    """The legs of one tripod are lifted; then their coxae, free of the ground, swing forward in one move."""
    lifted = np.tile([[0.0, 0.5, 0.0], [0.0, 0.0, 0.0]], (3, 1)).ravel()
    forward = lifted + np.tile([[0.4, 0.0, 0.0], [0.0, 0.0, 0.0]], (3, 1)).ravel()
    script = Script(np.array([0.0, 1.0]), np.stack([lifted, forward]))
    return EmulatedRobot(SEED, hidden, strength).rollout(Scene(), 2.0, script, trial=trial)


def crossing(recording: Recording) -> float:
    """s after the command at which the swinging coxae pass half of their move."""
    coxa = recording.joint_position[:, COXAE][:, ::2].mean(axis=1)
    start, end = coxa[45:50].mean(), coxa[-10:].mean()
    return float(np.interp((start + end) / 2, coxa[50:70], recording.time[50:70])) - 1.0


def truth(hidden: str, strength: str = "strong") -> dict[str, Any]:
    return choose(hidden, strength, SEED)[2].truth


def test_dry_friction_stops_the_joints_short_of_where_they_would_settle() -> None:
    free, rubbing = (
        swing(hidden).joint_position[-10:, COXAE][:, ::2].mean() for hidden in ("none", "coulomb_friction")
    )
    assert rubbing < free - 0.005


def test_teeth_slide_at_the_sliding_torque_and_hold_below_it() -> None:
    friction = SlippingTeeth("strong", np.random.default_rng(0))
    for _ in range(500):
        sliding = friction.resist(np.full(18, 2.0), 1e-3)
    assert sliding == pytest.approx(-friction.size - 2.0 * friction.GREASE, rel=0.01)
    friction.reset(np.zeros(18))
    angle, speed, inertia = np.zeros(18), np.zeros(18), 1e-3
    for push in np.concatenate([np.linspace(0.0, 0.8, 1000), np.full(2000, 0.8)]):
        speed = speed + 1e-3 * (push * friction.size + friction.resist(speed, 1e-3)) / inertia
        angle = angle + 1e-3 * speed
    assert np.abs(speed).max() < 1e-3 and 0 < angle.max() < friction.SLIP[-1]


def test_damping_makes_a_swing_later_by_damping_over_gain() -> None:
    delay = crossing(swing("viscous_damping")) - crossing(swing("none"))
    gain = Specimen.of(SEED, "none").character.gain
    assert delay == pytest.approx(truth("viscous_damping")["damping_n_m_s_per_rad"] / gain, rel=0.35)


def test_latency_shifts_a_swing_and_jitters() -> None:
    quiet = crossing(swing("none"))
    delays = [crossing(swing("command_latency", trial=trial)) - quiet for trial in range(4)]
    mean, jitter = truth("command_latency")["latency_s"], truth("command_latency")["jitter_s"]
    assert np.mean(delays) == pytest.approx(mean, abs=3 * jitter)
    assert np.std(delays) > 0.1 * jitter


def test_backlash_lets_the_leg_lag_the_encoder_by_half_the_gap_under_load() -> None:
    body = standing("backlash")
    play = body.shaft - body._angles
    half = truth("backlash")["gap_rad"] / 2
    femurs = np.abs(play[1::3])
    assert femurs.min() > 0.9 * half and femurs.max() < 1.6 * half  # the teeth give a little


def test_teeth_only_push_and_only_beyond_the_gap() -> None:
    gear = GearGap(0.04, 7e-4, 0.05, 1)
    gear.reset(np.zeros(1))
    still = np.zeros(1)
    assert gear.push(np.full(1, 0.01), still, still, 1e-3)[0] == 0.0
    for _ in range(2000):
        torque = gear.push(np.full(1, 0.1), still, still, 1e-3)
    assert torque[0] == pytest.approx(0.1, rel=0.02)
    assert gear.position[0] == pytest.approx(0.02 + 0.1 / gear.STIFFNESS, rel=0.02)


def test_what_rubs_in_a_servo_rubs_on_its_own_side_of_a_loose_horn(monkeypatch: pytest.MonkeyPatch) -> None:
    rubbed: list[np.ndarray] = []

    def resist(self: SlippingTeeth, velocity: np.ndarray, dt: float) -> np.ndarray:
        rubbed.append(velocity * dt)
        return np.zeros(18)

    monkeypatch.setattr(SlippingTeeth, "resist", resist)
    body = standing("backlash+coulomb_friction", settle=0.5)
    turned = np.sum(rubbed, axis=0)[1::3]
    assert np.abs(turned - body.shaft[1::3]).max() < 2e-3 < 0.01 < np.abs(turned - body._angles[1::3]).min()


def test_a_weak_leg_sags_while_the_others_hardly_do() -> None:
    leg = LEGS.index(str(truth("weak_leg")["leg"]))
    sag = np.abs(standing("weak_leg")._angles - standing("none")._angles).reshape(6, 3).max(axis=1)
    assert sag[leg] > 0.005 and sag[leg] == sag.max()


def test_a_payload_adds_its_weight_and_leans_the_trunk_to_its_side() -> None:
    bare, loaded = standing("none"), standing("payload")
    weight = loaded.data.sensordata[6:].sum() - bare.data.sensordata[6:].sum()
    assert weight == pytest.approx(GRAVITY * truth("payload")["mass_kg"], rel=0.05)
    roll, pitch, _ = np.subtract(roll_pitch_yaw(loaded.true_attitude()), roll_pitch_yaw(bare.true_attitude()))
    assert -roll * truth("payload")["y_m"] > 1e-6  # left side down is a negative roll
    assert pitch * truth("payload")["x_m"] > 1e-5  # nose down is a positive pitch


@pytest.mark.parametrize("name", DRAWN)
def test_every_effect_stands_out_of_the_noise_and_more_when_strong(name: str) -> None:
    reference = swing("none").joint_position
    floor = np.sqrt(np.mean(np.square(swing("none", trial=1).joint_position - reference)))
    attitude = swing("none").attitude
    errors = {}
    for strength in ("weak", "strong"):
        run = swing(name, strength)
        errors[strength] = np.sqrt(np.mean(np.square(run.joint_position - reference)))
        errors[strength] += np.sqrt(np.mean(np.square(run.attitude - attitude)))
    assert errors["strong"] > errors["weak"] > 1.5 * floor


def test_none_has_nothing_hidden() -> None:
    _, _, effect = choose("none", "strong", SEED)
    drawing = drawings.load()
    build = Build(drawing.damping, drawing.armature, [])
    effect.attach(build, drawing)
    torque = np.linspace(-0.4, 0.4, 18)
    assert build == Build(drawing.damping, drawing.armature, [])
    assert effect.truth == {} and GearGap.of(build, 18) is None
    assert effect.bus_delay(np.random.default_rng(0)) == 0.0
    assert effect.hear([(0, 0.1)], True, np.random.default_rng(0)) == [(0, 0.1)]
    assert np.array_equal(effect.drive(torque.copy(), torque), torque)
    assert not any(effect.uses(hook) for hook in ("resist", "act", "mount", "gyro"))
    assert effect.resist(torque, 1e-3) is None


def test_seeds_draw_every_effect_and_the_same_one_each_time() -> None:
    drawn = [Specimen.of(seed).hidden for seed in range(60)]
    assert set(drawn) == set(DRAWN)
    assert drawn == [Specimen.of(seed).hidden for seed in range(60)]


def test_every_name_has_its_effect() -> None:
    assert tuple(EFFECTS) == NAMES and len(set(NAMES)) == len(NAMES)


def test_every_effect_of_the_models_library_can_be_hidden() -> None:
    from tcbi_sim.effects import built_in
    from tcbi_sim.rigs import load_rig

    hexapod = load_rig("hexapod")
    assert set(LIBRARY) == {name for name, effect in built_in().items() if not effect.requires(hexapod)}


@pytest.mark.parametrize(
    ("hidden", "strength"), [("gremlins", "strong"), ("payload+gremlins", "weak"), ("payload", "huge")]
)
def test_an_unknown_effect_or_strength_is_refused_by_name(hidden: str, strength: str) -> None:
    with pytest.raises(EmulatedRobotError, match=r"gremlins|huge"):
        Specimen.of(0, hidden, strength)
