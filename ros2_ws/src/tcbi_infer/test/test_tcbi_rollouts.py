"""Which rollouts an inference takes, and how each is simulated."""

import dataclasses

import numpy as np
import pytest
from tcbi_cases import BENCH_TRUTH, bench_rollouts, hexapod_rollouts

from tcbi_infer.errors import InferError
from tcbi_infer.tcbi.driver import infer
from tcbi_infer.tcbi.loop import find_controllers
from tcbi_infer.tcbi.method import METHODS
from tcbi_infer.tcbi.problem import Problem
from tcbi_infer.tcbi.rollouts import checked, sample_rate
from tcbi_policy.errors import PolicyError
from tcbi_sim.measurement import Measurement
from tcbi_sim.model import base_model
from tcbi_sim.rig import Noise


@pytest.fixture(scope="module")
def bench():
    return bench_rollouts()


def test_rollouts_of_another_rig_are_refused(bench) -> None:
    with pytest.raises(InferError, match=r"is of rig hexapod.*of servo_bench"):
        Problem.of(base_model("hexapod"), bench[1])
    mixed = [*hexapod_rollouts("gait:tripod"), bench[1][0]]
    with pytest.raises(InferError, match=rf"but {bench[1][0].rollout_id} is of servo_bench; infer each rig's rollouts"):
        Problem.of(base_model("hexapod"), mixed)


def test_of_a_robot_that_never_moved_nothing_is_claimed(bench) -> None:
    model, measurements = bench
    still = [
        dataclasses.replace(m, joint_position=np.full_like(m.joint_position, 0.1 + 1e-9 * i))
        for i, m in enumerate(measurements)
    ]
    found = infer(Problem.of(model, still, timestep=0.01), particles=20, generations=2)
    assert any(line.startswith("the same in every sample") and "early_response" in line for line in found.warnings)
    assert any("no parameters reproduce joint positions" in line for line in found.warnings)
    assert found.fits is False and not any(e.identified for e in found.estimates)


def test_too_few_or_identical_rollouts_are_refused(bench) -> None:
    model, measurements = bench
    with pytest.raises(InferError, match="at least 2 are needed"):
        Problem.of(model, measurements[:1])
    copies = [dataclasses.replace(measurements[0], rollout_id=f"copy{i}") for i in range(4)]
    with pytest.raises(InferError, match="identical to the last bit"):
        Problem.of(model, copies)


def test_a_rollout_that_is_another_one_again_counts_once(bench) -> None:
    model, measurements = bench
    again = [dataclasses.replace(measurements[0], rollout_id=f"copy{i}") for i in range(2)]
    problem = Problem.of(model, [measurements[0], *again, *measurements[1:3]], timestep=0.01)
    assert problem.rollout_ids == tuple(m.rollout_id for m in measurements[:3])
    assert any("2 rollouts left out: another one again to the last bit" in line for line in problem.warnings)


def test_rollouts_that_differ_in_any_signal_are_no_copies() -> None:
    one, other = hexapod_rollouts("gait:tripod")
    tilted = dataclasses.replace(other, joint_position=one.joint_position)
    assert len(checked(base_model("hexapod"), [one, tilted])[0]) == 2


@pytest.mark.parametrize("what", ["task", "source", "policy"])
def test_the_one_of_many_rollouts_that_is_of_something_else_is_named(bench, what: str) -> None:
    model, measurements = bench
    stray = measurements[3]
    if what == "task":
        other = dataclasses.replace(stray, scenario=dataclasses.replace(stray.scenario, task="swing"))
    else:
        other = dataclasses.replace(stray, **{"source": {"source": "elsewhere"}, "policy": {"policy_id": "lost"}}[what])
    (line,) = (s for s in checked(model, [*measurements[:3], other, *measurements[4:]])[1] if "taken together" in s)
    usual = {"task": "steps", "source": stray.source, "policy": stray.policy_id}[what]
    remedy = "" if what == "policy" else f": leave {stray.rollout_id} out, or infer from them apart"
    assert line.endswith(f"; all but {stray.rollout_id} are of {usual}{remedy}")
    halves = [dataclasses.replace(m, source=f"{i % 2}") for i, m in enumerate(measurements)]
    assert "all but" not in " ".join(checked(model, halves)[1])


def test_few_rollouts_mixed_tasks_and_repeated_ids_are_said(bench) -> None:
    model, measurements = bench
    other = dataclasses.replace(measurements[2].scenario, task="swing")
    mixed = [*measurements[:2], dataclasses.replace(measurements[2], scenario=other, source="driver"), measurements[0]]
    problem = Problem.of(model, mixed, timestep=0.01)
    text = " ".join(problem.warnings)
    assert "only 3 rollouts" in text and "several tasks (steps, swing)" in text and "each counts once" in text
    assert f"several sources (driver, {measurements[0].source})" in text
    assert problem.blocks == 3 and problem.observed.counts.shape[0] == 9


def test_recordings_of_unequal_length_are_each_cut_to_their_own_group(bench) -> None:
    model, measurements = bench
    short = dataclasses.replace(measurements[0].scenario, duration=1.5)
    problem = Problem.of(
        model, [dataclasses.replace(measurements[0], scenario=short), *measurements[1:]], timestep=0.01
    )
    assert sorted(round(g.duration, 1) for g in problem.groups) == [1.5, 3.0]
    assert problem.simulate(np.full((2, 3), 0.5)).counts.shape[:2] == (2, 8)


def test_a_rollout_with_missing_samples_is_left_out_and_that_is_said(bench) -> None:
    model, measurements = bench
    torn, there = measurements[0], (measurements[0].time < 1.0) | (measurements[0].time > 1.6)
    torn = dataclasses.replace(torn, time=torn.time[there], joint_position=torn.joint_position[there])
    problem = Problem.of(model, [torn, *measurements[1:]], timestep=0.01)
    assert torn.rollout_id not in problem.rollout_ids
    assert f"{torn.rollout_id} left out: samples, commands or a signal are missing" in " ".join(problem.warnings)


@pytest.mark.parametrize("reading", [np.nan, np.inf])
@pytest.mark.parametrize(("samples", "left_out"), [(1, False), (30, True)])
def test_a_rollout_is_left_out_where_many_readings_are_no_numbers(bench, reading, samples, left_out) -> None:
    model, measurements = bench
    joints = measurements[0].joint_position.copy()
    joints[40 : 40 + samples] = reading
    unread = dataclasses.replace(measurements[0], joint_position=joints)
    problem = Problem.of(model, [unread, *measurements[1:]], timestep=0.01)
    assert (unread.rollout_id not in problem.rollout_ids) == left_out
    assert all(np.isfinite(values).all() for values in problem.real_samples)


def test_where_nothing_is_left_it_is_said_why(bench) -> None:
    model, measurements = bench
    short = [dataclasses.replace(m, time=m.time[:10], joint_position=m.joint_position[:10]) for m in measurements]
    with pytest.raises(InferError, match=r"^0 usable rollouts, .*record more; .*left out: fewer than 20"):
        Problem.of(model, short)


@pytest.mark.parametrize(("begin", "left_out"), [(1.0, True), (np.inf, False)])
def test_a_rollout_of_which_a_signal_ended_early_is_left_out(bench, begin, left_out) -> None:
    model, measurements = bench
    cut = dataclasses.replace(measurements[0], gaps=(("joint_position", begin, np.inf),))
    problem = Problem.of(model, [cut, *measurements[1:]], timestep=0.01)
    assert (cut.rollout_id not in problem.rollout_ids) == left_out


def test_the_few_rollouts_that_lack_a_signal_are_left_out_so_that_the_others_keep_its_statistics() -> None:
    walking = hexapod_rollouts("gait:tripod", count=4)
    blind = dataclasses.replace(walking[0], attitude=None)
    problem = Problem.of(base_model("hexapod"), [blind, *walking[1:]])
    assert blind.rollout_id not in problem.rollout_ids and "attitude" in {s.name for s in problem.statistics}
    assert f"{blind.rollout_id} left out: no attitude was recorded, which the others have" in " ".join(problem.warnings)
    all_blind = [dataclasses.replace(m, attitude=None) for m in walking]
    assert len(Problem.of(base_model("hexapod"), all_blind).rollout_ids) == len(walking)


def test_samples_that_were_not_measured_count_nowhere(bench) -> None:
    model, measurements = bench
    gap = measurements[0].joint_position.copy()
    gap[20:24] = np.nan
    patchy = [dataclasses.replace(measurements[0], joint_position=gap), *measurements[1:]]
    unit = np.array([BENCH_TRUTH, (0.9, *BENCH_TRUTH[1:])])
    for name in ("calibrated", "rejection"):
        method = METHODS[name]
        seen = Problem.of(model, patchy, timestep=0.01).simulate(unit, view=method.view)
        whole = Problem.of(model, measurements, timestep=0.01).simulate(unit, view=method.view)
        parts = (*seen[:-1], *seen.differences) if name == "calibrated" else seen
        assert all(np.isfinite(part).all() for part in parts if part.size and not np.isnan(part).all())
        assert np.allclose(seen[1 if name == "calibrated" else 0], whole[1 if name == "calibrated" else 0], rtol=0.2)


@pytest.mark.parametrize(("recorded", "open_loop", "closed_loop"), [(50, 50, 50), (15, 50 / 3, 25), (9, 50 / 6, 10)])
def test_slow_recordings_are_simulated_at_a_rate_that_a_controller_can_act_at(recorded, open_loop, closed_loop) -> None:
    (m,) = hexapod_rollouts("balance", count=1)
    slow = m.resampled(np.arange(0.0, 1.0, 1 / recorded))
    model = base_model("hexapod")
    assert sample_rate(model, [slow], closed_loop=False) == pytest.approx(open_loop)
    assert sample_rate(model, [slow], closed_loop=True) == pytest.approx(closed_loop)


def test_without_its_policy_the_commands_are_replayed_and_that_is_said(bench) -> None:
    controllers, said = find_controllers(bench[1], "auto", None)
    assert controllers == {} and said.startswith("open loop: the recorded commands are replayed, since")


def simulated(measurements: list[Measurement], loop: str = "acting") -> dict[str, np.ndarray]:
    """Rollout -> (2, T, J) joint angles and commands of two robots without noise."""
    problem = dataclasses.replace(
        Problem.of(base_model("hexapod"), measurements, loop=loop, timestep=0.01), noise=Noise(0.0)
    )
    found = {}
    for group, arrays in zip(problem.groups, problem.rollouts(np.full((2, 3), [[0.3], [0.6]])).readings, strict=True):
        for s, m in enumerate(group.measurements):
            found[m.rollout_id] = np.concatenate(
                [arrays.joint_position[:, s].ravel(), arrays.command_target[:, s].ravel(), arrays.command_time[s]]
            )
    return found


def test_beside_a_policy_gaits_are_replayed_with_the_bits_they_have_alone() -> None:
    trained, gaits = hexapod_rollouts("balance"), hexapod_rollouts("gait:steps", "gait:tripod")
    mixed = simulated([*trained, *gaits])
    apart = simulated(trained, "closed") | simulated(gaits, "open")
    assert mixed.keys() == apart.keys() and all(np.array_equal(mixed[i], apart[i]) for i in apart)
    alone = simulated(trained) | simulated(gaits)
    assert all(np.array_equal(alone[i], apart[i]) for i in apart), "so it is without the others"


def test_beside_a_policy_at_hand_one_that_is_not_is_replayed_and_that_is_said() -> None:
    trained = hexapod_rollouts("balance")
    lost = [
        dataclasses.replace(
            m, policy_id="lost@1", rollout_id=f"{m.rollout_id}_lost", joint_position=m.joint_position + 1e-9
        )  # recordings of their own
        for m in trained
    ]
    gaits = hexapod_rollouts("gait:steps")
    controllers, said = find_controllers([*trained, *lost, *gaits], "acting", None)
    assert list(controllers) == [trained[0].policy_id]
    assert said.startswith(f"closed loop: {trained[0].policy_id} acts on the simulated robot; for the other rollouts")
    assert "since scripted gaits do not react and a policy cannot be loaded (lost@1 is not here)" in said
    with pytest.raises(PolicyError, match="'lost' does not exist"):
        find_controllers([*trained, *lost], "closed", None)
    assert len(find_controllers([*trained, *gaits], "closed", None)[0]) == 2
    mixed, apart = simulated([*trained, *lost]), simulated(trained) | simulated(lost)
    assert all(np.array_equal(mixed[i], apart[i]) for i in apart)


def test_walks_are_replayed_unless_it_is_the_published_method() -> None:
    balancing = hexapod_rollouts("balance")
    walking = [
        dataclasses.replace(m, scenario=dataclasses.replace(m.scenario, task="forward"))
        for m in hexapod_rollouts("forward")
    ]

    def acting(measurements: list[Measurement]) -> set[str]:
        return {name for name, method in METHODS.items() if find_controllers(measurements, method.loop, None)[0]}

    assert acting(balancing) == set(METHODS)
    assert acting(walking) == {"paper"}
    controllers, said = find_controllers([*balancing, *walking], "auto", None)
    assert list(controllers) == [balancing[0].policy_id]
    assert said.endswith("replayed, since task forward counts distance")


def test_noisy_readings_are_replayed() -> None:
    trained, rng = hexapod_rollouts("balance"), np.random.default_rng(0)
    assert Problem.of(base_model("hexapod"), trained).closed_loop
    noisy = [
        dataclasses.replace(m, joint_position=m.joint_position + 0.05 * rng.standard_normal(m.joint_position.shape))
        for m in trained
    ]
    problem = Problem.of(base_model("hexapod"), noisy)
    assert not problem.closed_loop
    assert any("replayed, since readings are noisy" in line for line in problem.warnings)
