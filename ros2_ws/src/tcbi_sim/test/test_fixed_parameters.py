"""Parameters that were measured otherwise stay where they are."""

import json

import numpy as np
import pytest

from tcbi_sim.engine import simulate
from tcbi_sim.errors import SimError, UnknownNameError
from tcbi_sim.measurement import Commands, Scenario
from tcbi_sim.mjcf import materialise, to_xml
from tcbi_sim.model import base_model
from tcbi_sim.store import ModelStore, StoreError

HEXAPOD = base_model("hexapod")
FIXED = HEXAPOD.with_fixed({"mass": 0.86})


def test_a_model_with_a_fixed_mass_moves_as_one_whose_parameter_is_that_mass():
    commands, scenario = Commands(np.array([0.0]), np.full((1, 18), 0.2)), Scenario("balance", 0.4)
    whole = simulate(HEXAPOD, np.array([[0.7, 0.86, 2.0]]), [scenario], commands=[commands], timestep=0.01)
    fewer = simulate(FIXED, np.array([[0.7, 2.0]]), [scenario], commands=[commands], timestep=0.01)
    assert FIXED.names == ("friction", "gain")
    np.testing.assert_array_equal(whole.joint_position, fewer.joint_position)
    assert materialise(FIXED).body_mass[2:].sum() == pytest.approx(0.86, rel=0.01)
    assert "mass = 0.86 (fixed)" in to_xml(FIXED)


def test_the_others_keep_their_distribution_and_a_freed_one_is_as_wide_as_its_prior():
    np.testing.assert_array_equal(FIXED.particles, HEXAPOD.particles[:, [0, 2]])
    free = FIXED.with_free(["mass"])
    assert free.names == HEXAPOD.names and not free.fixed and free.fixed_told == "nothing" and free.made_by == "fix"
    np.testing.assert_array_equal(free.particles[:, [0, 2]], FIXED.particles)
    spread = np.ptp(free.particles[:, 1]) / (HEXAPOD.parameters[1].high - HEXAPOD.parameters[1].low)
    assert spread > 0.9
    assert FIXED.contents != HEXAPOD.with_fixed({"mass": 0.9}).contents


def test_effects_come_and_go_beside_what_is_fixed_and_their_own_parameters_may_be_fixed():
    loaded = FIXED.with_effect("payload").with_fixed({"payload.mass": 0.1})
    assert loaded.names == ("friction", "gain", "payload.moment_x", "payload.moment_y")
    assert loaded.fixed_told == "mass 0.86 kg, payload.mass 0.1 kg" and loaded.made_by == "fix"
    values = {**loaded.fixed, **dict(zip(loaded.names, loaded.mean(), strict=True))}
    free = HEXAPOD.with_effect("payload")
    heavy = materialise(free, np.array([values[name] for name in free.names]))
    np.testing.assert_allclose(materialise(loaded).body_mass, heavy.body_mass)
    assert loaded.without_effect("payload").fixed == {"mass": 0.86}


def test_what_cannot_be_fixed_is_told():
    for values, word in (({"mass": 9.0}, "allowed is 0.4 to 1.2 kg"), ({"mass": float("nan")}, "allowed is 0.4")):
        with pytest.raises(SimError, match=word):
            HEXAPOD.with_fixed(values)
    with pytest.raises(UnknownNameError, match="friction, gain"):
        FIXED.with_fixed({"mass": 0.9})
    with pytest.raises(UnknownNameError, match="known: mass"):
        FIXED.with_free(["gain"])
    with pytest.raises(SimError, match="every parameter is fixed"):
        FIXED.with_fixed({"friction": 0.7, "gain": 2.0})


def test_a_store_keeps_what_is_fixed_and_refuses_what_does_not_fit(tmp_path):
    store = ModelStore(tmp_path)
    saved = store.save(FIXED)
    loaded = store.load(saved.version)
    assert loaded.fixed == {"mass": 0.86} and loaded.names == FIXED.names
    np.testing.assert_array_equal(loaded.particles, FIXED.particles)
    path = store.models / saved.version / "model.json"
    head = json.loads(path.read_text())
    for fixed, word in (
        ({"mass": 9.0}, "0.4 to 1.2"),
        ({"weight": 1.0}, "weight|parameters"),
        ({"mass": "a"}, "fixed"),
    ):
        path.write_text(json.dumps({**head, "fixed": fixed}))
        with pytest.raises(StoreError, match=word):
            store.load(saved.version)


def test_a_version_from_before_anything_could_be_fixed_is_read(tmp_path):
    store = ModelStore(tmp_path)
    saved = store.save(HEXAPOD.with_effect("backlash"))
    path = store.models / saved.version / "model.json"
    head = json.loads(path.read_text())
    del head["fixed"]
    path.write_text(json.dumps(head))
    assert store.load(saved.version).fixed == {}
