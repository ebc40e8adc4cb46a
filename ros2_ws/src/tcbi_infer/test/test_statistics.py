"""Statistics: the right numbers on motions that can be worked out by hand; one code path for real and simulated."""

import numpy as np
import pytest

from tcbi_infer.errors import InferError
from tcbi_infer.statistics import CALIBRATED, RolloutArrays, from_measurements, library, select
from tcbi_sim.engine import simulate
from tcbi_sim.errors import UnknownNameError
from tcbi_sim.measurement import Commands, Measurement, Scenario
from tcbi_sim.model import base_model

TIME = np.arange(0, 101) / 50.0


def arrays(**changes: object) -> RolloutArrays:
    """One joint that lags a commanded step of 0.4 rad by 40 ms, on two feet, one of them always on the ground."""
    command_time = np.array([[0.0, 1.0]])
    ramp = 0.4 * np.clip((TIME - 1.04) / 0.2, 0, 1)
    contact = np.zeros((1, 1, len(TIME), 2), bool)
    contact[..., 0] = True
    contact[..., : len(TIME) // 4, 1] = True
    values = {
        "time": TIME,
        "joint_position": ramp[None, None, :, None],
        "command_time": command_time,
        "command_target": np.array([0.0, 0.4]).reshape(1, 1, 2, 1),
        "command_ramp": 0.2,
        "scenarios": (Scenario("balance", 2.0),),
        "joint_names": ("a",),
        "foot_names": ("l", "r"),
        "contact": contact,
        "attitude": np.tile([1.0, 0, 0, 0], (1, 1, len(TIME), 1)),
        "angular_velocity": np.ones((1, 1, len(TIME), 3)),
    }
    return RolloutArrays(**(values | changes))  # type: ignore[arg-type]


def test_every_statistic_gives_the_promised_shape() -> None:
    view = arrays()
    for name in CALIBRATED:
        statistic = library()[name]
        assert statistic.missing(view) == ""
        assert statistic.compute(view).shape[:3] == (1, 1, len(statistic.channels(view)))


def test_tracking_error_is_zero_when_the_joint_follows_the_ramp() -> None:
    view = arrays()
    perfect = arrays(joint_position=np.nan_to_num(view.reference))
    assert np.allclose(library()["joint_tracking"].compute(perfect), 0, atol=1e-12)
    assert library()["joint_tracking"].compute(view).min() == pytest.approx(-0.08)  # 40 ms at 2 rad/s


def test_early_response_is_the_share_of_the_step_after_60_ms() -> None:
    share = library()["early_response"].compute(arrays())[0, 0, 0]
    assert np.isnan(share[0])
    assert share[1] == pytest.approx(0.02 / 0.2)  # 60 ms less 40 ms of lag, on a ramp of 200 ms


def test_early_response_takes_falling_steps_as_rising_ones() -> None:
    rising = arrays()
    falling = arrays(joint_position=-rising.joint_position, command_target=-rising.command_target)
    early = library()["early_response"]
    assert early.missing(falling) == ""
    np.testing.assert_array_equal(early.compute(falling), early.compute(rising))


def test_early_response_without_steps_is_left_out_by_name() -> None:
    still = arrays(command_target=np.zeros((1, 1, 2, 1)))
    _, left_out = select(("early_response", "body_rates"), still)
    assert len(left_out) == 1 and "early_response" in left_out[0]


def test_contact_ratio_counts_time_on_the_ground() -> None:
    ratio = library()["contact_ratio"].compute(arrays())[0, 0]
    assert ratio[0].tolist() == [1.0]
    assert ratio[1, 0] == pytest.approx(0.25, abs=0.01)


def test_reward_is_the_training_reward() -> None:
    reward = library()["reward"].compute(arrays())[0, 0, 0]
    assert reward == pytest.approx([0.0, -600 * 0.4**2])


def test_without_a_tracker_the_distance_at_the_end_gives_one_reward_a_rollout() -> None:
    reward = library()["reward"]
    forward = {"scenarios": (Scenario("forward", 2.0),)}
    measured = arrays(**forward, distance=np.array([[0.05]]))
    assert reward.missing(measured) == ""
    assert reward.compute(measured) == pytest.approx(np.full((1, 1, 1, 1), (90000 * 0.05 - 600 * 0.4**2) / 2))
    assert "neither a position nor a distance" in reward.missing(arrays(**forward))
    assert np.isnan(reward.compute(arrays(**forward, distance=np.array([[np.nan]])))).all()


def test_a_missing_signal_is_named_and_the_rest_is_used() -> None:
    kept, left_out = select(CALIBRATED, arrays(attitude=None, contact=None))
    assert {s.name for s in kept} == {"joint_tracking", "early_response", "body_rates", "joint_motion"}
    assert "no attitude" in " ".join(left_out) and "no contact" in " ".join(left_out)


def test_unknown_statistic_and_nothing_left_are_refused() -> None:
    with pytest.raises(UnknownNameError, match="unknown statistic 'speed'"):
        select(("speed",), arrays())
    with pytest.raises(InferError, match="no statistic can be computed"):
        select(("attitude",), arrays(attitude=None))


def test_a_simulated_rollout_and_its_measurement_have_equal_statistics() -> None:
    model = base_model("servo_bench")
    commands = Commands(np.array([0.0, 0.4, 0.8]), np.array([[0.5], [-0.5], [0.2]]))
    rollouts = simulate(model, model.mean(), [Scenario("steps", 1.2)], commands=[commands], timestep=0.01)
    m = rollouts.measurement(0, 0)
    assert isinstance(m, Measurement)
    time = m.time[(m.time >= 0)]
    view = from_measurements([m], time)
    direct = RolloutArrays(
        time=time,
        joint_position=rollouts.joint_position[:, :, : len(time)],
        command_time=commands.time[None],
        command_target=commands.target[None, None],
        command_ramp=commands.ramp,
        scenarios=(m.scenario,),
        joint_names=m.joint_names,
        foot_names=(),
    )
    for name in ("joint_tracking", "early_response"):
        assert np.allclose(library()[name].compute(view), library()[name].compute(direct), atol=1e-12, equal_nan=True)
