"""Every effect does nothing at its null value, something at its nominal one, and states what it is."""

import numpy as np
import pytest

from tcbi_sim.effects import candidates, find_use, library
from tcbi_sim.engine import simulate
from tcbi_sim.errors import SimError
from tcbi_sim.measurement import Commands, Measurement, Scenario
from tcbi_sim.model import base_model
from tcbi_sim.rigs import load_rig

HEXAPOD, BENCH = load_rig("hexapod"), load_rig("servo_bench")
SCENARIO = Scenario("balance", 2.0, 0.1, -0.05)
COMMANDS = Commands(np.arange(10) * 0.2, np.random.default_rng(0).uniform(-0.3, 0.3, (10, 18)))
BENCH_SCENARIO = Scenario("bench", 2.0)
STEPS = np.random.default_rng(0).normal(0, np.repeat([0.2, 0.01], 50))  # rad: far and fast, then in small steps
BENCH_COMMANDS = Commands(np.arange(100) * 0.02, np.cumsum(STEPS)[:, None], 0.0)


def replay(rig: str, key: str | None, values: dict[str, float]) -> Measurement:
    model = base_model(rig)
    row = {p.name: p.nominal for p in model.parameters} | values
    if key:
        model = model.with_effect(key)
    scenario, commands = (SCENARIO, COMMANDS) if rig == "hexapod" else (BENCH_SCENARIO, BENCH_COMMANDS)
    out = simulate(model, np.array([[row[n] for n in model.names]]), [scenario], commands=[commands], timestep=0.002)
    assert not out.diverged.any()
    return out.measurement(0)


def difference(a: Measurement, b: Measurement, signals: tuple[str, ...]) -> float:
    """The largest root mean square difference of some signals."""
    pairs = [(getattr(a, s), getattr(b, s)) for s in signals]
    return max(float(np.sqrt(np.mean((x - y) ** 2))) for x, y in pairs if x is not None and y is not None)


USES = [("hexapod", u.key) for u in candidates(HEXAPOD) if u.site in ("", "lm", "lm_femur")]
USES += [("servo_bench", u.key) for u in candidates(BENCH)]


@pytest.mark.parametrize(("rig", "key"), USES)
def test_an_effect_vanishes_at_its_null_value_and_acts_at_its_nominal_one(rig, key):
    use = find_use(key, load_rig(rig))
    null = {p.name: p.nominal if p.null is None else p.null for p in use.parameters}
    base = replay(rig, None, {})
    structural = use.effect.edit is not None
    signals = ("joint_position", "attitude") if structural else ("joint_position", "attitude", "angular_velocity")
    at_null = difference(base, replay(rig, key, null), signals)
    acting = difference(base, replay(rig, key, {p.name: p.nominal for p in use.parameters}), signals)
    assert acting > 1e-3
    assert at_null < (0.3 * acting if structural else 1e-9), "an added joint costs a little even at its null value"


@pytest.mark.parametrize("effect", library().values(), ids=library())
def test_an_effect_says_what_it_is_and_where_it_is_known_from(effect):
    assert len(effect.physics.split()) >= 15
    assert effect.source
    assert any(p.null is not None for p in effect.parameters)
    assert all(p.unit and p.description for p in effect.parameters)


def test_at_least_six_effects_suit_a_hexapod_and_some_a_bench():
    assert {"coulomb_friction", "viscous_damping", "command_latency", "backlash", "payload"} <= set(library())
    assert len({u.effect.name for u in candidates(HEXAPOD)}) >= 16
    assert candidates(BENCH) and not {u.effect.name for u in candidates(BENCH)} & {"weak_leg", "payload", "imu_tilt"}


@pytest.mark.parametrize("key", ["coulomb_frictoin", "weak_leg", "weak_leg:xx", "payload:lm"])
def test_an_unknown_effect_or_place_is_named(key):
    with pytest.raises(SimError, match=key.partition(":")[0]):
        find_use(key, HEXAPOD)


def test_an_effect_that_the_rig_cannot_have_is_refused_with_its_reason():
    with pytest.raises(SimError, match="does not stand on the ground"):
        find_use("payload", BENCH)


def test_a_users_own_effect_is_found_in_a_folder(tmp_path, monkeypatch):
    text = (
        "from tcbi_sim.effect import Effect\nfrom tcbi_sim.parameter import Parameter\n"
        "X = Parameter('x', '1', 0.0, 1.0, 0.5, null=0.0)\n"
        "EFFECT = Effect('my_effect', 'physics', 'source', (X,), lambda f, r, s, v: None)\n"
    )
    (tmp_path / "mine.py").write_text(text)
    monkeypatch.setenv("TCBI_EFFECTS", str(tmp_path))
    library.cache_clear()
    try:
        assert "my_effect" in library()
    finally:
        monkeypatch.delenv("TCBI_EFFECTS")
        library.cache_clear()
