"""The emulated robot stands, moves and repeats itself as a real one would."""

import math

import numpy as np
import pytest

from tcbi_bringup.emulated_robot.errors import EmulatedRobotError
from tcbi_bringup.emulated_robot.mechanics import GRAVITY, Box, Scene
from tcbi_bringup.emulated_robot.physics import Physics, Specimen
from tcbi_bringup.emulated_robot.rollout import EmulatedRobot, Script, roll_pitch_yaw
from tcbi_bringup.emulated_robot.servos import STEP
from tcbi_contract.names import JOINTS, LEGS

STANCE = np.zeros(18)


def physics(
    scene: Scene | None = None, hidden: str = "none", seed: int = 3, trial: int = 0, settle: float = 1.0
) -> Physics:
    """A robot that has stood on its ground for `settle` seconds."""
    body = Physics(Specimen.of(seed, hidden), trial)
    body.place(scene or Scene(), STANCE)
    body.advance_to(body.time + settle)
    return body


def feet(body: Physics) -> np.ndarray:
    """(6, 3) m, the feet in the frame of the ground."""
    return np.array([body.data.geom(f"{leg}_foot").xpos for leg in LEGS])


def dither(duration: float, size: float = 0.25, seed: int = 0) -> Script:
    """Random commands at 5 Hz."""
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, duration, 0.2)
    return Script(time, np.clip(np.cumsum(rng.normal(0.0, size / 2, (len(time), 18)), axis=0), -size, size))


@pytest.mark.parametrize(("roll", "pitch"), [(0.0, 0.0), (0.35, 0.0), (0.0, -0.35)])
def test_loaded_feet_do_not_creep(roll: float, pitch: float) -> None:
    body = physics(Scene(roll, pitch), settle=2.0)
    before = feet(body)
    body.advance_to(body.time + 10.0)
    assert np.linalg.norm(feet(body) - before, axis=1).max() < 0.5e-3


def test_the_feet_carry_the_weight() -> None:
    body = physics(settle=2.0)
    assert body.data.sensordata[6:].sum() == pytest.approx(GRAVITY * body.specimen.character.mass, rel=0.02)


def test_a_robot_on_too_steep_a_slope_slides() -> None:
    body = physics(settle=0.5)
    slope = math.atan(body.specimen.character.friction) + 0.15
    body.place(Scene(slope_roll=slope), STANCE)
    before = feet(body)
    body.advance_to(body.time + 1.0)
    assert (feet(body) - before)[:, 1].max() < -0.02  # rightwards, which is downhill


@pytest.mark.parametrize(("joint", "axis", "sign"), [("coxa", 0, 1), ("tibia", 1, 1)])
def test_positive_angles_move_the_foot_as_the_contract_says(joint: str, axis: int, sign: int) -> None:
    for leg, outward in (("lm", 1.0), ("rm", -1.0)):
        moved = STANCE.copy()
        moved[JOINTS.index(f"{leg}_{joint}")] = 0.2
        body = Physics(Specimen.of(3, "none"))
        start = feet(body)[LEGS.index(leg)]
        body.place(Scene(), moved)
        shift = feet(body)[LEGS.index(leg)] - start
        assert shift[axis] * (outward if axis == 1 else 1.0) * sign > 0.01


def test_a_positive_femur_lifts_the_knee() -> None:
    body = Physics(Specimen.of(3, "none"))
    knee = [body.data.body(f"{leg}_tibia").xpos[2] - body.data.body("base_link").xpos[2] for leg in LEGS]
    body.place(Scene(), np.tile([0.0, 0.2, 0.0], 6))
    lifted = [body.data.body(f"{leg}_tibia").xpos[2] - body.data.body("base_link").xpos[2] for leg in LEGS]
    assert min(np.subtract(lifted, knee)) > 0.01


def test_attitude_and_accelerometer_agree_on_the_slope() -> None:
    sample = physics(Scene(slope_roll=0.2, slope_pitch=-0.1), settle=2.0).read()
    roll, pitch, _ = roll_pitch_yaw(sample.attitude)
    assert (roll, pitch) == (pytest.approx(0.2, abs=0.03), pytest.approx(-0.1, abs=0.03))
    ax, ay, az = sample.linear_acceleration
    assert math.atan2(ay, az) == pytest.approx(roll, abs=0.03)
    assert math.asin(-ax / math.hypot(ax, ay, az)) == pytest.approx(pitch, abs=0.03)


@pytest.mark.parametrize("seed", [0, 4])
def test_the_fused_attitude_of_a_standing_robot_has_no_bias(seed: int) -> None:
    """In the mean of four trials, which a second's noise moves by 0.2 mrad: a false alarm in fewer than 1 of 10,000."""
    errors = []
    for trial in range(4):
        body = Physics(Specimen.of(seed, "none"), trial)
        body.place(Scene(), np.zeros(18))
        body.advance_to(1.2)
        errors.append(np.subtract(roll_pitch_yaw(body.read().attitude), roll_pitch_yaw(body.true_attitude()))[:2])
    assert np.abs(np.mean(errors, axis=0)).max() < 0.9e-3


def test_a_block_lifts_the_robot_that_is_put_on_it() -> None:
    low = physics().true_position()[2]
    high = physics(Scene(blocks=(Box((0.0, 0.0, 0.035), (0.8, 0.8, 0.07)),))).true_position()[2]
    assert high - low == pytest.approx(0.07, abs=0.002)


def test_a_move_takes_its_time_in_whole_steps() -> None:
    body = physics(settle=0.5)
    start, goal = body.read().joint_position, np.full(18, 0.2)
    body.send(goal, 0.2)
    body.advance_to(body.time + 0.1)
    halfway = body.read().joint_position
    body.advance_to(body.time + 1.0)
    end = body.read().joint_position
    assert np.all(halfway[::3] > start[::3] + 0.04) and np.all(halfway[::3] < 0.12)
    assert np.abs(end[::3] - 0.2).max() < 0.05
    assert np.allclose(end / STEP, np.rint(end / STEP))


def test_a_limp_servo_gives_no_torque_and_holds_where_it_is_when_it_comes_on() -> None:
    body = physics()
    for i in range(18):
        body.switch(i, False)
    body.advance_to(body.time + 1.0)
    assert not body.read().load.any()
    lying = body.read().joint_position
    assert np.abs(lying).max() > 0.2
    for i in range(18):
        body.switch(i, True)
    body.advance_to(body.time + 0.5)
    assert np.abs(body.read().joint_position - lying).max() < 0.05


def test_same_robot_same_trial_same_bits() -> None:
    first, second = (
        EmulatedRobot(5, "command_latency").rollout(Scene(0.1), 1.0, dither(1.0), trial=2) for _ in range(2)
    )
    for name in ("joint_position", "attitude", "angular_velocity", "linear_acceleration", "contact", "position"):
        assert getattr(first, name).tobytes() == getattr(second, name).tobytes(), name


def test_trials_of_one_run_differ_as_much_as_careful_repeats_of_a_real_robot() -> None:
    robot = EmulatedRobot(3, "none")
    runs = [robot.rollout(Scene(0.1), 2.0, dither(2.0), trial=trial) for trial in range(4)]
    joints = np.array([run.joint_position for run in runs])
    apart = np.degrees(np.std(joints, axis=0, ddof=1).mean())
    assert 0.04 < apart < 0.5, "degrees: more than the encoders' step, less than what a hidden effect does"
    headings = [math.degrees(roll_pitch_yaw(run.attitude[0])[2]) for run in runs]
    assert 0.1 < np.std(headings, ddof=1) < 3.0, "put down by hand"


def test_noise_alone_makes_readings_of_the_same_pose_differ() -> None:
    body = physics()
    a, b = body.read(), body.read()
    assert not np.array_equal(a.joint_position, b.joint_position)
    assert np.abs(a.joint_position - b.joint_position).max() <= 5 * STEP


def test_robots_differ_between_seeds_inside_the_plausible_middle() -> None:
    truths = [Specimen.of(seed, "none").character for seed in range(30)]
    assert len({c.gain for c in truths}) == 30
    for c in truths:
        assert 0.55 <= c.friction <= 0.95 and 0.6 <= c.mass <= 1.0 and 1.5 <= c.gain <= 5.0
        assert 0.01 < np.std(c.gain_factor) < 0.06


def test_recordings_are_sampled_at_50_hz_with_the_commands_that_were_given() -> None:
    script = dither(1.0)
    recording = EmulatedRobot(1, "none").rollout(Scene(), 1.0, script)
    assert np.allclose(np.diff(recording.time), 0.02) and len(recording.time) == 51
    assert np.array_equal(recording.command_time, script.time)
    assert np.array_equal(recording.command_target, script.target)


class Stepper:
    """A controller that notes what it sees and asks for a fixed posture."""

    def __init__(self) -> None:
        self.seen: list[tuple[float, np.ndarray]] = []

    def reset(self, count: int, rng: np.random.Generator) -> None:
        self.seen.clear()

    def act(self, time: float, observation: np.ndarray) -> np.ndarray:
        self.seen.append((time, observation[0]))
        return np.full((1, 18), 0.1)


def test_a_controller_is_asked_five_times_a_second_with_angles_and_attitude() -> None:
    controller = Stepper()
    recording = EmulatedRobot(1, "none").rollout(Scene(slope_roll=0.15), 1.0, controller)
    assert [t for t, _ in controller.seen] == pytest.approx([0.0, 0.2, 0.4, 0.6, 0.8])
    assert controller.seen[0][1].shape == (21,)
    assert controller.seen[-1][1][18] == pytest.approx(0.15, abs=0.05)
    assert abs(controller.seen[0][1][20]) < 1e-9  # yaw counts from the start
    assert recording.joint_position[-1, ::3] == pytest.approx(0.1, abs=0.05)


class Dice(Stepper):
    """A controller that notes what it could draw."""

    def reset(self, count: int, rng: np.random.Generator) -> None:
        super().reset(count, rng)
        self.drawn = rng.standard_normal(3)


def test_a_controller_draws_otherwise_on_each_robot_and_trial_and_apart_from_the_robots_own_streams() -> None:
    def drawn(seed: int, trial: int) -> tuple[float, ...]:
        controller = Dice()
        EmulatedRobot(seed, "none").rollout(Scene(), 0.04, controller, settle=0.02, trial=trial)
        return tuple(controller.drawn)

    every = {drawn(seed, trial) for seed in (1, 2) for trial in (0, 5)}
    assert len(every) == 4 and drawn(1, 5) in every
    others = [(1, stream, 0) for stream in range(6)]  # numpy takes (1, 5) for the tracker's (1, 5, 0)
    assert not every & {tuple(np.random.default_rng(key).standard_normal(3)) for key in others}


@pytest.mark.parametrize("target", [np.zeros((2, 17)), np.zeros((3, 18))])
def test_a_script_of_the_wrong_shape_is_refused(target: np.ndarray) -> None:
    with pytest.raises(EmulatedRobotError, match="strictly increasing times"):
        EmulatedRobot(1, "none").rollout(Scene(), 1.0, Script(np.array([0.0, 0.2]), target))


def test_a_limp_robot_comes_to_lie_still_and_stands_up_again() -> None:
    body = physics(Scene(slope_roll=0.1, slope_pitch=0.05), settle=1.5)  # longer than from look to look
    standing = body.true_position()[2]
    for servo in range(18):
        body.switch(servo, False)
    body.advance_to(body.time + 20.0)
    lying = body.data.qpos.copy()
    assert body.true_position()[2] < standing - 0.02
    body.switch(0, False)  # it is: nobody wakes
    body.advance_to(body.time + 1.0)
    assert np.array_equal(body.data.qpos, lying)  # to the bit: its mechanics rest
    samples = [body.read() for _ in range(50)]
    assert np.abs(np.mean([s.angular_velocity for s in samples], axis=0)).max() < 0.005
    weight = np.linalg.norm(np.mean([s.linear_acceleration for s in samples], axis=0))
    assert weight == pytest.approx(GRAVITY, abs=0.06)
    turned = 2 * np.arccos(min(abs(float(samples[-1].attitude @ body.true_attitude())), 1.0))
    assert turned < 0.02  # the fused attitude does not run away from where the robot lies
    assert samples[-1].contact.any()
    for servo in range(18):
        body.switch(servo, True)
    body.send(STANCE, 0.5)
    body.advance_to(body.time + 2.0)
    assert np.abs(body.read().joint_position).max() < 0.35
    assert body.true_position()[2] > 0.03
