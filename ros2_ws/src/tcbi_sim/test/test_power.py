"""What servos give through links that bend, with back-EMF and without power."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tcbi_sim.engine import simulate
from tcbi_sim.measurement import Commands, Scenario
from tcbi_sim.model import Model, base_model
from tcbi_sim.power import MADE_UP, ServoPower
from tcbi_sim.simulator import Simulator

STIFFNESS, DAMPING, BACK_EMF, COMPLIANCE, STRENGTH = 5.0, 0.4, 0.3, 0.2, 0.7


def rows(model: Model, key: str, values: list[float]) -> np.ndarray:
    """(N, P), nominal but for one parameter."""
    nominal = {p.name: p.nominal for p in model.parameters}
    return np.array([[(nominal | {key: value})[n] for n in model.names] for value in values])


def test_links_that_bend_leave_a_servos_lag_as_it_is():
    """The arm's base turns about an upright axis at one speed, without load; judged over the last 2 s."""
    model = base_model("so101_arm").with_effect("link_flexibility")
    times, speed = np.arange(0.0, 3.0, 0.02), 0.5
    targets = np.zeros((len(times), 6))
    targets[:, 0] = speed * (times + 0.02)
    values = rows(model, "link_flexibility.compliance", [0.0, 0.1])
    commands = [Commands(times, targets, 0.02)]
    out = simulate(model, values, [Scenario("ramp", 3.0, settle=0.0)], commands=commands, timestep=0.002)
    late = (speed * out.time - out.joint_position[:, 0, :, 0])[:, -100:].mean(axis=1) / speed
    assert late[0] == pytest.approx(0.02, abs=0.002)
    assert late[1] == pytest.approx(late[0], abs=0.01)


def powered(made_up: float, back_emf: float, on: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Gain, bias and damping of a servo, with the part of its back-EMF that its loop makes up for."""
    model = {
        "actuator_gainprm": np.array([[[STIFFNESS, 0.0, 0.0]]]),
        "actuator_biasprm": np.array([[[0.0, -STIFFNESS, -DAMPING]]]),
        "actuator_forcerange": np.array([[[-1.0, 1.0]]]),
        "dof_damping": np.zeros((1, 1)),
    }
    fields: Any = SimpleNamespace(
        model=model,
        strength=np.array([[STRENGTH]]),
        compliance=np.array([[COMPLIANCE]]),
        powered_damping=np.array([[back_emf]]),
        stall_torque=np.zeros((1, 1)),
        memory={MADE_UP: np.array([[made_up]])} if made_up else {},
    )
    indices = np.zeros(1, int)
    power = ServoPower(fields, indices, indices)
    power.begin()
    power.write(np.array([on]))
    return tuple(model[n][0, 0] for n in ("actuator_gainprm", "actuator_biasprm", "dof_damping"))


@pytest.mark.parametrize(("made_up", "back_emf"), [(0.0, 0.0), (0.0, BACK_EMF), (BACK_EMF, BACK_EMF)])
def test_a_bent_link_feels_the_torque_of_a_servo_whose_own_angle_is_beyond_it(made_up, back_emf):
    """Against the servo's own equation, at an angle that is ahead of the link by torque times compliance."""
    target, link, speed = 0.6, 0.2, -1.5
    gain, bias, damping = powered(made_up, back_emf, on=True)
    felt = gain[0] * target + bias[1] * link + bias[2] * speed - damping * speed
    servo = link + COMPLIANCE * felt
    motor = STRENGTH * STIFFNESS * (target - servo) - DAMPING * speed + made_up * speed
    assert felt == pytest.approx(motor - back_emf * speed, rel=1e-12)


@pytest.mark.parametrize("made_up", [0.0, BACK_EMF])
def test_without_power_a_servo_gives_nothing_and_nothing_is_made_up_for(made_up):
    gain, bias, damping = powered(made_up, BACK_EMF, on=False)
    assert not gain.any() and not bias.any() and damping == 0.0


def test_a_slow_link_that_bends_does_not_know_of_the_speed_limit():
    model = base_model("servo_bench").with_effect("speed_limit").with_effect("link_flexibility")
    values = rows(model, "speed_limit.slowness", [0.0, 0.3])
    simulator = Simulator(model, values, [Scenario("bench", 1.0)] * 2, threads=1)
    simulator.command(np.full((2, 1), 0.3), 0.5)
    for _ in range(10):
        slow_reading, free_reading = simulator.advance(0.05).joint_position[:, -1, 0]
        slow, free = (simulator.materialise(i)[1].qpos[0] for i in range(2))
        assert slow == pytest.approx(free, abs=1e-9) and slow_reading == pytest.approx(free_reading, abs=1e-9)
    assert slow > 0.05


def test_full_load_is_that_of_the_torque_limit_a_simulation_has():
    """A stalled motor keeps 1 / (1 + drop) of whatever torque it began with."""
    model = base_model("servo_bench").with_effect("torque_saturation").with_effect("battery_sag")
    values = rows(model, "torque_saturation.share", [0.1, 0.2])
    drop = dict(zip(model.names, values[0], strict=True))["battery_sag.drop"]
    simulator = Simulator(model, values, [Scenario("bench", 1.0)] * 2, threads=1)
    whole = simulator.fields.stall_torque.copy()
    simulator.command(np.full((2, 1), 3.0), 0.05)
    for _ in range(40):
        simulator.advance(0.05)
    now = np.abs(simulator._actuator_force[:, simulator._actuators])
    assert now / whole == pytest.approx(np.full((2, 1), 1 / (1 + drop)), rel=0.02)


def test_the_speed_limit_is_made_up_for_whichever_effect_a_model_got_first(tmp_path, monkeypatch):
    """`gravity_droop` scales a servo's damping, but not what its loop makes up for."""
    (tmp_path / "arm.xml").write_text(
        '<mujoco><worldbody><body><joint name="hinge"/><geom size=".1" mass="1"/></body></worldbody></mujoco>'
    )
    (tmp_path / "stiff_arm.toml").write_text(
        'model = "arm.xml"\n[servo]\ngain = 5.0\nlag = 0.05\ntorque_limit = 1.0\n'
        '[parameters.damping]\nunit = "N m s/rad"\nlow = 0.0\nhigh = 1.0\nnominal = 0.1\n'
    )
    monkeypatch.setenv("TCBI_RIGS", str(tmp_path))
    effects = ["speed_limit", "gravity_droop:hinge"]
    terms = []
    for order in (effects, effects[::-1]):
        model = base_model("stiff_arm")
        for key in order:
            model = model.with_effect(key)
        values = rows(model, "speed_limit.slowness", [0.3])
        simulator = Simulator(model, values, [Scenario("arm", 1.0, settle=0.0)], threads=1)
        terms.append(simulator.fields.model["actuator_biasprm"][0, 0, 2])
    assert terms[0] == pytest.approx(terms[1], rel=1e-12)
