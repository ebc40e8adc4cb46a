"""Every effect does nothing at its null value, something at its nominal one, and states what it is."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from tcbi_sim.effect_trial import EXACT, try_use
from tcbi_sim.effects import built_in, candidates, find_use
from tcbi_sim.engine import simulate
from tcbi_sim.errors import SimError
from tcbi_sim.measurement import Commands, Scenario, roll_pitch_yaw
from tcbi_sim.mjcf import materialise
from tcbi_sim.model import base_model
from tcbi_sim.rigs import load_rig
from tcbi_sim.simulator import Simulator
from tcbi_sim.user_effects import incomplete, unusable

HEXAPOD, BENCH = load_rig("hexapod"), load_rig("servo_bench")
CONTRACT = {
    "coulomb_friction",
    "viscous_damping",
    "stribeck_friction",
    "rotor_inertia",
    "command_latency",
    "sensor_latency",
    "backlash",
    "torque_saturation",
    "speed_limit",
    "thermal_fading",
    "battery_sag",
    "command_deadband",
    "lost_commands",
    "weak_leg",
    "gain_scatter",
    "joint_offset",
    "payload",
    "link_flexibility",
    "soft_ground",
    "slippery_ground",
    "imu_tilt",
    "gyro_bias",
    "slope_error",
    "cable_pull",
}
REMAINS = {"backlash": 5e-3, "slippery_ground": 2e-3}  # rad: a second hinge; feet that stand on the edge touch twice
TRIED = ("", "lm", "lm_femur", "servo")  # one site of each kind
USES = [
    (rig.name, u.key)
    for rig in (HEXAPOD, BENCH)
    for u in candidates(rig)
    if u.site in TRIED and u.effect.name in built_in()
]


@pytest.mark.parametrize(("rig", "key"), USES)
def test_an_effect_vanishes_at_null_acts_at_nominal_stays_finite_at_the_ends_and_leaves_others_alone(rig, key):
    trial = try_use(find_use(key, load_rig(rig)), load_rig(rig))
    assert trial.faults == ()
    assert max(trial.change.values()) > 1e-3
    assert trial.null_change <= REMAINS.get(key.partition(":")[0], EXACT)


@pytest.mark.parametrize("effect", built_in().values(), ids=built_in())
def test_an_effect_says_what_it_is_and_where_it_is_known_from(effect):
    assert unusable(effect) == [] and incomplete(effect) == []


def test_the_library_has_every_effect_of_the_contract():
    assert set(built_in()) >= CONTRACT
    assert {u.effect.name for u in candidates(HEXAPOD)} >= CONTRACT
    assert candidates(BENCH) and not {u.effect.name for u in candidates(BENCH)} & {"weak_leg", "payload", "imu_tilt"}


@pytest.mark.parametrize("key", ["coulomb_frictoin", "weak_leg", "weak_leg:xx", "payload:lm"])
def test_an_unknown_effect_or_place_is_named(key):
    with pytest.raises(SimError, match=key.partition(":")[0]):
        find_use(key, HEXAPOD)


def test_an_effect_that_the_rig_cannot_have_is_refused_with_its_reason():
    with pytest.raises(SimError, match="does not stand on the ground"):
        find_use("payload", BENCH)


def bench(key: str, **values: float) -> Simulator:
    """A bench that holds its arm level, with one effect."""
    model = base_model("servo_bench").with_effect(key)
    row = {p.name: p.nominal for p in model.parameters} | {f"{key}.{n}": v for n, v in values.items()}
    scenario = Scenario("bench", 2.0, initial_joint_position=(np.pi / 2,))
    return Simulator(model, np.array([[row[n] for n in model.names]] * 2), [scenario] * 2, threads=1)


def trunk(effects: tuple[str, ...] = (), **values: float) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass, centre and inertia tensor of a hexapod's trunk in its own axes."""
    model = base_model("hexapod")
    for key in effects:
        model = model.with_effect(key)
    row = dict(zip(model.names, model.mean(), strict=True)) | {"mass": 0.9} | values
    own = materialise(model, np.array([row[n] for n in model.names]))
    body, axes = own.body("base_link"), np.empty(9)
    mujoco.mju_quat2Mat(axes, body.iquat)
    turn = axes.reshape(3, 3)
    return float(body.mass[0]), body.ipos, turn @ np.diag(body.inertia) @ turn.T


def loaded(mass: float, moment_x: float, moment_y: float) -> tuple[float, np.ndarray, np.ndarray]:
    """The trunk with a payload."""
    told = {"mass": mass, "moment_x": moment_x, "moment_y": moment_y}
    return trunk(("payload",), **{f"payload.{name}": value for name, value in told.items()})


@pytest.mark.parametrize("added", [0.0, 0.3])
def test_a_payload_adds_a_point_mass_to_the_trunk(added):
    """Against the inertia tensors of all masses about the origin, which add up (parallel axes)."""
    place = np.array([0.1, -0.06, 0.03])
    mass, center, inertia = loaded(added, *(added * place[:2]))
    old_mass, old_center, old_inertia = trunk()

    def about_origin(m, r):
        return m * (r @ r * np.eye(3) - np.outer(r, r))

    np.testing.assert_allclose(mass, old_mass + added)
    np.testing.assert_allclose(mass * center, old_mass * old_center + added * place, atol=1e-12)
    whole = old_inertia + about_origin(old_mass, old_center) + about_origin(added, place)
    np.testing.assert_allclose(inertia + about_origin(mass, center), whole, atol=1e-9)


def test_a_moment_without_a_mass_moves_the_centre_of_the_trunk_alone():
    (old_mass, old_center, old_inertia), (mass, center, inertia) = trunk(), loaded(0.0, 0.01, -0.02)
    assert mass == old_mass
    np.testing.assert_allclose(center - old_center, np.array([0.01, -0.02, 0.0]) / old_mass)
    np.testing.assert_allclose(inertia, old_inertia)


@pytest.mark.parametrize("key", ["battery_sag", "thermal_fading"])
def test_servos_weaken_under_load_and_a_new_episode_begins_fresh_while_others_go_on(key):
    simulator = bench(key, time_constant=5.0)
    simulator.advance(1.0)
    after_load = simulator.fields.strength.copy()
    assert (after_load < 0.99).all()
    limit, gain = (simulator.fields.model[f][:, 0] for f in ("actuator_forcerange", "actuator_gainprm"))
    np.testing.assert_allclose(limit[:, 1], after_load[:, 0] * 0.104 * 7.4, rtol=1e-9)
    np.testing.assert_allclose(gain[:, 0], after_load[:, 0] * 4e-3 * 200, rtol=1e-9)
    simulator.reset(ids=np.array([1]))
    np.testing.assert_allclose(simulator.fields.strength[:, 0], [after_load[0, 0], 1.0])


@pytest.mark.parametrize("key", ["battery_sag", "thermal_fading"])
@pytest.mark.parametrize("name", ["double_pendulum", "so101_arm"])
def test_servos_without_a_stall_torque_do_not_weaken_by_a_share_of_it(name, key):
    rig = load_rig(name)
    assert key not in {u.effect.name for u in candidates(rig)}
    with pytest.raises(SimError, match="has a torque limit"):
        find_use(key, rig)


def stalled(key: str, seconds: float, **values: float) -> float:
    """Torque that is left, over all torque, of a bench's servo that has stood under too heavy an arm."""
    model = base_model("servo_bench").with_effect(key)
    row = {p.name: p.nominal for p in model.parameters} | {f"{key}.{n}": v for n, v in values.items()}
    heavy = Scenario("bench", seconds, constants=(("mass", 5.0), ("kp", 2000.0)))
    simulator = Simulator(model, np.array([[row[n] for n in model.names]]), [heavy], threads=1)
    simulator.command(np.full((1, 1), 3.0), 0.0)
    simulator.advance(seconds)
    return float(simulator.fields.strength[0, 0])


def test_a_battery_s_drop_is_torque_lost_over_torque_left_where_servos_stall():
    assert stalled("battery_sag", 3.0, drop=0.5) == pytest.approx(1 / 1.5, rel=0.01)


def test_a_motor_s_loss_is_torque_lost_over_torque_left_a_second_at_stall():
    """Warmth w grows by loss / (1 + w)^2 a second, since the load falls with the torque that is left."""
    assert stalled("thermal_fading", 1.0, loss=1.0, time_constant=300.0) == pytest.approx(4 ** (-1 / 3), rel=0.01)


def test_a_servo_that_was_off_comes_back_as_weak_as_it_was():
    simulator = bench("thermal_fading", time_constant=300.0)
    simulator.advance(1.0)
    weak = simulator.fields.model["actuator_gainprm"][0, 0, 0]
    simulator.set_torque(False)
    assert simulator.fields.model["actuator_gainprm"][0, 0, 0] == 0
    simulator.advance(0.1)
    simulator.set_torque(True)
    assert simulator.fields.model["actuator_gainprm"][0, 0, 0] == pytest.approx(weak, rel=0.01)


def test_a_link_bends_by_its_compliance_times_the_torque_behind_its_encoder():
    simulator = bench("link_flexibility", compliance=0.2)
    simulator.command(np.full((2, 1), np.pi / 2))
    reading = simulator.advance(10.0).joint_position[0, -1, 0]
    link = simulator.materialise(0)[1].qpos[0]
    torque = simulator.materialise(0)[1].actuator_force[0]
    assert torque == pytest.approx(4e-3 * 200 * (np.pi / 2 - reading), rel=1e-6), "the servo is as stiff as before"
    assert reading - link == pytest.approx(0.2 * torque, rel=1e-6)
    assert torque == pytest.approx(0.49 * 9.81 * 0.10 * np.sin(link), abs=0.025), "it holds the arm, less friction"


@pytest.mark.parametrize(("slowness", "fastest"), [(0.0, 18.0), (0.5, 1.95)])
def test_a_motor_gets_no_faster_than_where_its_torque_is_used_up(slowness, fastest):
    model = base_model("servo_bench").with_effect("speed_limit")
    row = {"gain": 0.05, "damping": 1e-3, "friction": 1e-3, "speed_limit.slowness": slowness}
    commands = Commands(np.array([0.0]), np.array([[3.0]]), 0.0)
    values = np.array([[row[n] for n in model.names]])
    scenario = Scenario("bench", 1.0, constants=(("mass", 0.01),))
    out = simulate(model, values, [scenario], commands=[commands], timestep=0.001)
    speed = np.diff(out.joint_position[0, 0, :, 0]).max() * out.rig.rate
    assert speed < 2.0 if slowness else speed > 5.0
    assert speed == pytest.approx(fastest, rel=0.5)


def test_dry_friction_of_no_torque_leaves_even_a_frictionless_rig_as_it_is():
    trial = try_use(find_use("coulomb_friction", load_rig("double_pendulum")), load_rig("double_pendulum"))
    assert trial.faults == () and trial.null_change <= EXACT


def test_dry_friction_rubs_on_without_power():
    model = base_model("double_pendulum").with_effect("coulomb_friction")
    values = np.array([[p.nominal for p in model.parameters]])
    times, nothing = np.arange(2) * 0.1, np.zeros((2, 2))
    swing = Scenario("swing", 5.0, initial_joint_position=(1.0, 0.0))
    powered, limp = (
        simulate(model, values, [swing], commands=[Commands(times, nothing, 0.0, torque_on=on)]).joint_position
        for on in (None, np.zeros(2, bool))
    )
    np.testing.assert_array_equal(limp, powered)


def test_a_gyroscope_is_biased_about_its_own_axes_however_the_imu_is_mounted():
    model = base_model("hexapod").with_effect("imu_tilt").with_effect("gyro_bias")
    nominal = {p.name: p.nominal for p in model.parameters}
    tilt, bias = {"imu_tilt.roll": 0.1, "imu_tilt.pitch": 0.0}, {f"gyro_bias.{a}": 0.0 for a in "xyz"}
    rows = [nominal | tilt | bias, nominal | tilt | bias | {"gyro_bias.z": 0.05}]
    values = np.array([[row[n] for n in model.names] for row in rows])
    commands = Commands(np.array([0.0]), np.full((1, 18), 0.1))
    plain, biased = simulate(model, values, [Scenario("move", 0.2)], commands=[commands]).angular_velocity
    np.testing.assert_allclose(biased - plain, np.broadcast_to([0.0, 0.0, 0.05], plain.shape), atol=1e-12)


def test_a_slow_motion_does_not_know_of_the_speed_limit():
    values = np.array([[4e-3, 0.015, 0.02], [4e-3, 0.015, 0.02]])
    model = base_model("servo_bench").with_effect("speed_limit")
    commands = Commands(np.arange(20) * 0.1, 0.02 * np.sin(np.arange(20) * 0.3)[:, None], 0.1)
    out = simulate(
        model, np.c_[values, [0.0, 0.3]], [Scenario("bench", 2.0)], commands=[commands], timestep=0.001
    ).joint_position
    np.testing.assert_allclose(out[0], out[1], atol=1e-6)


def standing(key: str, rows: list[dict[str, float]], scenario: Scenario) -> np.ndarray:
    """(N, 3) m, how far the trunk gets in a rollout without commands beyond the first posture."""
    model = base_model("hexapod").with_effect(key)
    nominal = {p.name: p.nominal for p in model.parameters}
    values = np.array([[(nominal | {f"{key}.{k}": v for k, v in r.items()})[n] for n in model.names] for r in rows])
    commands = Commands(np.array([0.0]), np.zeros((1, 18)))
    out = simulate(model, values, [scenario], commands=[commands], timestep=0.005)
    assert out.position is not None
    return out.position[:, 0, -1] - out.position[:, 0, 0]


def test_a_cable_pulls_the_trunk_its_way():
    moved = standing(
        "cable_pull",
        [{"x": 1.0, "y": 0.0}, {"x": -1.0, "y": 0.0}, {"x": 0.0, "y": 1.0}],
        Scenario("s", 2.0, settle=0.0),
    )
    assert moved[0, 0] > 0.001 > -0.001 > moved[1, 0] and moved[2, 1] > 0.001


def test_a_robot_slides_down_a_slope_only_where_the_ground_is_slippery():
    patches = [{"grip": 1.0}, {"grip": 0.1, "begin": -0.3}, {"grip": 0.1, "begin": 1.0}]
    moved = np.linalg.norm(standing("slippery_ground", patches, Scenario("s", 1.0, 0.2, 0.0)), axis=1)
    assert moved[1] > 0.05 and moved[0] < 0.01 and moved[2] < 0.01


def test_ground_of_one_grip_leaves_a_robot_level_that_stands_across_the_edge():
    edges = [(0.0, 0.0), (0.0, np.pi / 2), (0.05, 0.7)]
    model, start = base_model("hexapod").with_effect("slippery_ground"), Scenario("s", 1.0)
    values = np.array([[0.75, 0.8, 2.5, 1.0, *edge] for edge in edges])
    commands = [Commands(np.array([0.0]), np.zeros((1, 18)))]
    across = simulate(model, values, [start], commands=commands, timestep=0.005)
    even = simulate(base_model("hexapod"), values[:1, :3], [start], commands=commands, timestep=0.005)
    assert across.attitude is not None and even.attitude is not None
    tilt = roll_pitch_yaw(across.attitude) - roll_pitch_yaw(even.attitude)
    bent = across.joint_position - even.joint_position
    assert np.degrees(np.abs(tilt)).max() < 0.003 and np.degrees(np.abs(bent)).max() < 0.05


def test_a_robot_slides_on_a_slippery_patch_as_on_ground_of_that_friction():
    slope, model = Scenario("s", 1.0, 0.2, 0.0), base_model("hexapod")
    commands = [Commands(np.array([0.0]), np.zeros((1, 18)))]
    there = standing("slippery_ground", [{"grip": 0.25, "begin": -1.0}], slope)[0]
    values = np.array([[p.nominal for p in model.parameters]]) * [[0.25, 1.0, 1.0]]
    ground = simulate(model, values, [slope], commands=commands, timestep=0.005).position
    assert ground is not None
    np.testing.assert_allclose(there, ground[0, 0, -1] - ground[0, 0, 0], atol=1e-3)


def test_a_joint_with_dry_friction_gives_way_before_it_slides_and_springs_back_but_not_once_it_slid():
    torque, presliding = 0.05, 0.01
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body()
    body.add_joint(name="hinge", type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 0, 1], armature=1e-3, damping=[0.05, 0, 0])
    body.add_geom(size=[0.01, 0, 0], mass=0.01)
    rig = SimpleNamespace(joint_names=("hinge",))
    effect = built_in()["coulomb_friction"]
    effect.edit(spec, rig, "")
    model = spec.compile()
    arrays = {name: getattr(model, name)[None] for name in ("actuator_dynprm", "actuator_biasprm")}
    fields = SimpleNamespace(model=arrays, actuators=lambda names: [model.actuator(n).id for n in names])
    effect.apply(fields, rig, "", {"torque": np.array([torque]), "presliding": np.array([presliding])})
    data = mujoco.MjData(model)

    def settled(load: float) -> float:
        data.qfrc_applied[0] = load
        mujoco.mj_step(model, data, 2000)
        return float(data.qpos[0])

    bent = settled(0.5 * torque)
    assert 0.5 * presliding < bent < presliding, "bristles bend"
    assert settled(0.0) < 0.6 * bent, "and spring back, if not all the way"
    assert settled(1.2 * torque) > 20 * presliding, "it slides"
    assert settled(0.0) > 20 * presliding, "and stays where it slid to"


def test_which_packets_a_robot_loses_does_not_depend_on_the_robots_beside_it():
    """Another one's commands at other times are none of its own."""
    model = base_model("servo_bench").with_effect("lost_commands")
    row = model.mean()
    row[model.names.index("lost_commands.share")] = 0.5
    rng, scenario = np.random.default_rng(0), Scenario("bench", 3.0, seed=1)
    times = np.arange(0.0, 3.0, 0.2)
    own = Commands(times, rng.uniform(-1, 1, (len(times), 1)))
    other = Commands(times + 0.07, own.target)
    alone = simulate(model, row[None], [scenario], commands=[own]).joint_position[0, 0]
    beside = simulate(model, row[None], [scenario, scenario], commands=[own, other]).joint_position[0, 0]
    np.testing.assert_array_equal(alone, beside)
