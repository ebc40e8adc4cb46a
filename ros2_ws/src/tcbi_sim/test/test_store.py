"""Model versions survive the disk, and damaged ones are refused in words."""

import dataclasses
import errno
import json
import re
import subprocess
import sys

import h5py
import mujoco
import numpy as np
import pytest

from tcbi_sim.effects import including, library
from tcbi_sim.errors import SimError, UnknownNameError
from tcbi_sim.mjcf import materialise, to_xml
from tcbi_sim.model import base_model
from tcbi_sim.rigs import RIGS
from tcbi_sim.store import ModelStore, StoreError


@pytest.fixture
def store(tmp_path) -> ModelStore:
    return ModelStore(tmp_path)


def test_an_empty_store_has_version_0_of_every_rig(store):
    assert store.versions() == [f"{name}-v0" for name in RIGS]
    assert store.load().version == "hexapod-v0"


def test_a_saved_version_comes_back_equal(store):
    saved = store.save(base_model("hexapod").with_effect("weak_leg:lm"))
    loaded = store.load()
    assert (loaded.version, loaded.parent, loaded.effects) == ("hexapod-v1", "hexapod-v0", ("weak_leg:lm",))
    np.testing.assert_array_equal(loaded.particles, saved.particles)
    np.testing.assert_array_equal(loaded.log_weights, saved.log_weights)


def test_a_version_keeps_each_joints_own_gain(store):
    model = dataclasses.replace(base_model("hexapod"), joint_gains=tuple(np.linspace(0.95, 1.05, 18)))
    version = store.save(model.with_effect("backlash")).version
    assert store.load(version).joint_gains == model.joint_gains
    assert store.load(version).joint_gains_told == "0.95 (lf_coxa) to 1.05 (rr_tibia)"
    assert store.load(version).without_effect("backlash").joint_gains == model.joint_gains


THREADS = """
import concurrent.futures, sys
from tcbi_sim.store import ModelStore
store = ModelStore(sys.argv[1])
with concurrent.futures.ThreadPoolExecutor(4) as pool:
    read = list(pool.map(lambda _: store.load("hexapod-v1", "hexapod").particles.shape, range(200)))
assert set(read) == {read[0]} and "netCDF4" not in sys.modules
"""


def test_several_threads_read_versions_at_once(store):
    store.save(base_model("hexapod").with_effect("backlash"))
    subprocess.run([sys.executable, "-c", THREADS, str(store.root)], check=True)


def test_a_full_disk_is_one_clear_line_and_leaves_the_store_as_it_was(store, monkeypatch):
    store.save(base_model("hexapod"))

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(store, "_write", full)
    with pytest.raises(StoreError, match=r"cannot write .*models: No space left on device; free space or choose"):
        store.save(base_model("hexapod"))
    assert [p.name for p in store.models.iterdir()] == ["hexapod-v1"]


@pytest.mark.parametrize("left", ["folder", "file"])
def test_a_number_that_something_else_has_is_skipped(store, left):
    first = store.save(base_model("hexapod"))
    place = store.models / "hexapod-v2"
    if left == "folder":  # as an interrupted `rm -r` leaves it
        place.mkdir()
    (place / "posterior.nc" if left == "folder" else place).write_bytes(b"")
    saved = store.save(first.with_effect("backlash"))
    assert (saved.version, saved.parent, store.load().version) == ("hexapod-v3", first.version, "hexapod-v3")
    assert store.versions("hexapod") == ["hexapod-v0", "hexapod-v1", "hexapod-v3"]


def test_versions_are_numbered_by_rig_and_remembered_by_parent(store):
    first = store.save(base_model("hexapod").with_effect("backlash"))
    second = store.save(first.with_effect("payload"))
    bench = store.save(base_model("servo_bench").with_effect("rotor_inertia"))
    assert (first.version, second.version, bench.version) == ("hexapod-v1", "hexapod-v2", "servo_bench-v1")
    assert second.parent == first.version
    with pytest.raises(StoreError, match="hexapod-v2"):
        store.delete(first.version)
    store.delete(second.version)
    assert store.load().version == first.version
    assert store.save(first.with_effect("payload")).version == "hexapod-v3", "policies may name the number"


def test_a_damaged_version_can_be_deleted_and_a_built_in_or_unknown_one_not(store):
    saved = store.save(base_model("hexapod"))
    (store.models / saved.version / "posterior.nc").write_bytes(b"no netCDF")
    store.delete(saved.version)
    assert store.versions("hexapod") == ["hexapod-v0"]
    with pytest.raises(StoreError, match="hexapod-v0 is built in"):
        store.delete("hexapod-v0")
    with pytest.raises(UnknownNameError, match="hexapod-v1"):
        store.delete(saved.version)


def test_what_plain_mujoco_cannot_hold_is_named_in_the_exported_mjcf():
    model = base_model("hexapod").with_effect("link_flexibility").with_effect("battery_sag").with_effect("payload")
    (line,) = [line for line in to_xml(model).splitlines() if "Not in this file" in line]
    assert "link_flexibility" in line and "battery_sag" in line and "payload" not in line


def test_draws_of_an_effects_prior_do_not_follow_other_parameters():
    model = base_model("hexapod").with_effect("coulomb_friction").with_effect("backlash")
    correlation = np.corrcoef(model.to_unit(model.particles).T) - np.eye(len(model.names))
    assert np.abs(correlation).max() < 0.35  # of 200 independent draws: 5 standard deviations


def test_removing_an_effect_leaves_the_marginal_of_the_others(store):
    model = base_model("hexapod").with_effect("backlash").with_effect("weak_leg:lm")
    weighted = store.save(model.with_particles(model.particles, np.log(np.linspace(1, 2, len(model.particles)))))
    child = store.save(weighted.without_effect("backlash"))
    assert (child.version, child.parent, child.effects) == ("hexapod-v2", "hexapod-v1", ("weak_leg:lm",))
    kept = [i for i, name in enumerate(weighted.names) if not name.startswith("backlash.")]
    np.testing.assert_array_equal(child.particles, weighted.particles[:, kept])
    np.testing.assert_array_equal(child.log_weights, weighted.log_weights)
    assert store.load("hexapod-v1").effects == ("backlash", "weak_leg:lm"), "the old version stays"
    assert weighted.without_effect("weak_leg").effects == ("backlash",), "the place may be left out where it is one"


def test_an_effect_that_the_model_does_not_have_or_has_at_two_places_is_refused():
    model = base_model("hexapod").with_effect("weak_leg:lm").with_effect("weak_leg:rf")
    for key in ("weak_leg", "backlash", "weak_leg:lr"):
        with pytest.raises(SimError, match=r"weak_leg:lm, weak_leg:rf"):
            model.without_effect(key)


def test_the_exported_mjcf_is_the_model(store):
    model = base_model("hexapod")
    for key in ("coulomb_friction", "payload", "backlash", "cable_pull", "slippery_ground", "speed_limit"):
        model = model.with_effect(key)
    model = dataclasses.replace(model, joint_gains=tuple(np.linspace(0.9, 1.1, 18)))
    loaded, own = mujoco.MjModel.from_xml_string(to_xml(model)), materialise(model)
    assert len(set(own.actuator_gainprm[:, 0])) >= 18
    for name in (
        "body_mass",
        "body_ipos",
        "dof_frictionloss",
        "dof_damping",
        "actuator_gainprm",
        "actuator_biasprm",
        "actuator_dynprm",
        "body_inertia",
        "tendon_stiffness",
        "tendon_lengthspring",
        "site_pos",
        "geom_pos",
        "jnt_range",
        "geom_friction",
    ):
        np.testing.assert_allclose(getattr(loaded, name), getattr(own, name), rtol=2e-5, atol=1e-6, err_msg=name)


def changed(store: ModelStore, change: dict) -> str:
    """The version of a saved model whose `model.json` is changed."""
    saved = store.save(base_model("hexapod").with_effect("backlash"))
    path = store.models / saved.version / "model.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    return saved.version


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"effects": ["gravity_waves"]}, "gravity_waves"),
        ({"format": 99}, "has format 99, allowed is 1; load it with the release .* or remove the folder"),
        ({"rig": "octopod"}, "octopod"),
        ({"rig": "servo_bench"}, "does not suit|parameters"),
        ({"effects": []}, r"parameters are friction, mass, gain, backlash\.\w+, allowed are friction, mass, gain;"),
        ({"parameters": []}, "parameters are none, allowed are friction, mass, gain, backlash"),
    ],
)
def test_a_model_file_with_unknown_content_is_refused_by_name(store, change, words):
    with pytest.raises(SimError, match=words):
        store.load(changed(store, change))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"effects": [5]}, "effects is [5], allowed is a list of texts"),
        ({"effects": "backlash"}, "effects is 'backlash', allowed is a list of texts"),
        ({"parameters": {"mass": 1.0}}, "parameters is {'mass': 1.0}, allowed is a list of objects"),
        ({"rig": None, "parent": 3}, "rig is None, allowed is a text; parent is 3, allowed is a text or null"),
        ({"evidence": []}, "evidence is [], allowed is an object"),
        ({"joint_gains": "all"}, "joint_gains is 'all', allowed is a list of numbers"),
    ],
)
def test_a_value_of_the_wrong_type_in_a_model_file_is_named_with_what_is_allowed(store, change, words):
    with pytest.raises(StoreError, match=re.escape(f"model.json: {words}; restore the file")):
        store.load(changed(store, change))


@pytest.mark.parametrize(
    ("rig", "gains", "words"),
    [
        ("hexapod", [1.0] * 17, "joint_gains has 17 values, allowed is 18 of 0.4 to 2.0"),
        ("hexapod", [1.0] * 17 + [9.8], "joint_gains has 18 values, among them 9.8, allowed is 18 of 0.4 to 2.0"),
        ("hexapod", [1.0] * 17 + [np.nan], "joint_gains has 18 values, among them nan, allowed"),
        ("double_pendulum", [1.0, 1.0], "joint_gains has 2 values, allowed is none for this rig"),
    ],
)
def test_joint_gains_that_a_rig_cannot_have_are_refused(store, rig, gains, words):
    saved = store.save(base_model(rig))
    path = store.models / saved.version / "model.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"joint_gains": gains}))
    with pytest.raises(StoreError, match=re.escape(words) + ".*restore the file"):
        store.load(saved.version)


@pytest.mark.parametrize("mean", [9.8, np.nan, "big", 0.79])
def test_a_mean_that_is_not_the_particles_is_refused_for_only_these_count(store, mean):
    saved = store.save(base_model("hexapod"))
    version = changed(store, {"mean": dict(zip(saved.names, saved.mean(), strict=False)) | {"mass": mean}})
    told = re.escape(f"mean mass is {mean!r}, allowed is {saved.mean()[1]:.6g}, which the particles")
    with pytest.raises(StoreError, match=told + ".*restore the file"):
        store.load(version)


@pytest.mark.parametrize("text", ["[]", "3", '"model"', "null"])
def test_a_model_file_that_holds_no_object_is_refused(store, text):
    saved = store.save(base_model("hexapod"))
    (store.models / saved.version / "model.json").write_text(text)
    with pytest.raises(StoreError, match=r"model.json: got .*, allowed is an object"):
        store.load(saved.version)


def test_the_history_leaves_out_a_version_that_cannot_be_read_and_says_so(store, caplog):
    broken, whole = (store.save(base_model("hexapod").with_effect(key)) for key in ("backlash", "payload"))
    path = store.models / broken.version / "model.json"
    path.write_text(path.read_text().replace('"backlash"', '"my_own_effect"'))
    assert [m.version for m in store.history("hexapod")] == ["hexapod-v0", whole.version]
    (line,) = [r.getMessage() for r in caplog.records]
    assert broken.version in line and "my_own_effect" in line and "\n" not in line


def test_bounds_written_into_a_model_file_do_not_widen_those_of_the_rig(store):
    saved = store.save(base_model("hexapod"))
    path = store.models / saved.version / "model.json"
    head = json.loads(path.read_text())
    head["parameters"][1] |= {"low": -5, "high": 1e9}
    path.write_text(json.dumps(head))
    assert store.load(saved.version).parameters == saved.parameters
    with h5py.File(path.with_name("posterior.nc"), "r+") as file:
        file["particles/value"][3, 1] = -3.0
    with pytest.raises(StoreError, match=r"posterior.nc: .*'mass' is -3.0, allowed is 0.4"):
        store.load(saved.version)


def test_a_model_takes_the_bounds_that_its_effect_has_by_now(store):
    saved = store.save(base_model("hexapod").with_effect("payload"))
    effect = library()["payload"]
    first = dataclasses.replace(effect.parameters[0], high=effect.parameters[0].high + 1.0)
    with including(dataclasses.replace(effect, parameters=(first, *effect.parameters[1:]))):
        assert store.load(saved.version).parameters[3].high == first.high


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_log_weight_that_is_no_number_is_refused_with_its_file(store, value):
    saved = store.save(base_model("hexapod"))
    with h5py.File(store.models / saved.version / "posterior.nc", "r+") as file:
        file["particles/log_weight"][3] = value
    with pytest.raises(StoreError, match=rf"posterior.nc: .*log-weight is {value}, allowed is a finite number"):
        store.load(saved.version)


def test_a_version_without_its_particles_is_told_so(store):
    saved = store.save(base_model("hexapod"))
    (store.models / saved.version / "posterior.nc").unlink()
    with pytest.raises(StoreError, match=r"posterior.nc is missing; restore the file or remove the folder"):
        store.load(saved.version)


def test_a_truncated_file_is_one_clear_line(store):
    saved = store.save(base_model("hexapod"))
    (store.models / saved.version / "posterior.nc").write_bytes(b"\x89HDF")
    with pytest.raises(StoreError, match="cannot read the model"):
        store.load(saved.version)


def test_a_rig_without_a_model_is_named_with_those_that_have_one(tmp_path):
    with pytest.raises(StoreError, match=r"rig 'quadruped' has no model.*hexapod"):
        ModelStore(tmp_path).load(rig="quadruped")


def test_a_particle_out_of_its_range_is_named_with_its_file_and_a_remedy(store):
    saved = store.save(base_model("hexapod"))
    path = store.models / saved.version / "posterior.nc"
    with h5py.File(path, "r+") as file:
        file["particles/value"][3, 1] = 50.0
    with pytest.raises(StoreError, match=r"posterior.nc: .*'mass' is 50.0, allowed is .* kg; restore the file or"):
        store.load(saved.version)
