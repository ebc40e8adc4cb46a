"""A comparison in pieces for the browser."""

import json

import numpy as np
import pytest
from cases import recording

from tcbi_dashboard import pack
from tcbi_dashboard.drawing import Ground, ground_normal, skeleton
from tcbi_infer.compare import compare
from tcbi_sim.measurement import Scenario
from tcbi_sim.model import base_model
from tcbi_sim.rigs import load_rig


@pytest.fixture(scope="module")
def packed(tmp_path_factory):
    """A comparison of two motions of the hexapod, each recorded twice, and its folder."""
    model = base_model("hexapod")
    rollouts = [recording(f"m{k}{again}", "hexapod", k, slope_roll=0.1 * k) for k in range(2) for again in "ab"]
    comparison = compare(model, rollouts, particles=2)
    return comparison, pack.write(tmp_path_factory.mktemp("runs"), model, comparison)


def test_arrays_come_back_as_they_were():
    arrays = {"time": np.arange(3.0), "measured": np.array([[1.5, np.nan], [2.0, 3.0]])}
    header, back = pack.decode(pack.encode({"rollout": "ü", "x": np.nan}, arrays))
    assert header["rollout"] == "ü" and header["x"] is None
    for name, values in arrays.items():
        np.testing.assert_array_equal(back[name], values.astype(np.float32))


def test_every_rollout_has_a_piece_with_what_was_compared(packed):
    comparison, folder = packed
    for r, m in enumerate(comparison.replay.measurements):
        header, arrays = pack.decode((folder / f"{r}.bin").read_bytes())
        length = len(arrays["time"])
        assert header["rollout"] == m.rollout_id
        np.testing.assert_allclose(arrays["measured"], comparison.replay.measured[r, :length].astype(np.float32))
        np.testing.assert_allclose(arrays["predicted"], comparison.predicted[r, :length].astype(np.float32))
        assert arrays["joints_measured"].shape == arrays["joints_predicted"].shape == (length, 18)
        assert arrays["base_measured"].shape == (length, 7) and np.isfinite(arrays["base_predicted"]).all()


def test_the_drawing_and_the_signals_show_the_same_prediction(packed):
    _, folder = packed
    _, arrays = pack.decode((folder / "2.bin").read_bytes())
    np.testing.assert_allclose(np.degrees(arrays["joints_predicted"]), arrays["predicted"][:, :18], atol=1e-3)


def test_the_summary_is_plain_json_and_holds_no_samples(packed):
    comparison, folder = packed
    text = (folder / "summary.json").read_text()
    summary = json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))
    assert summary["error_over_floor"] == pytest.approx(comparison.error_over_floor, rel=1e-4)
    assert [e["rollout"] for e in summary["each"]] == list(comparison.rollouts)
    assert len(summary["heat"]["joints"]) == len(summary["heat"]["values"][0]) == 18
    assert {m["rollout"] for m in summary["moments"]} <= set(range(4))
    assert all(m["begin"] <= m["peak"] <= m["end"] for m in summary["moments"])
    assert len(text) < 60_000


def test_a_cell_of_the_heat_map_leads_to_its_largest_error(packed):
    comparison, folder = packed
    heat = json.loads((folder / "summary.json").read_text())["heat"]
    joint, phase = 4, heat["phases"].index("at any time")
    rollout, time = heat["rollouts"][phase][joint], heat["times"][phase][joint]
    errors = np.abs(comparison.replay.measured - comparison.predicted)[..., joint]
    sample = int(np.argmin(np.abs(comparison.replay.time - time)))
    assert errors[rollout, sample] == pytest.approx(np.nanmax(errors))


def test_what_hardly_varies_is_told_instead_of_drawn(packed):
    _, folder = packed
    summary = json.loads((folder / "summary.json").read_text())
    drawn = {curve["condition"] for curve in summary["curves"]}
    assert drawn and not drawn & set(summary["steady"])


def test_only_the_newest_comparisons_are_kept(packed, tmp_path):
    comparison, _ = packed
    model = base_model("hexapod")
    made = [pack.write(tmp_path, model, comparison) for _ in range(pack.KEPT + 2)]
    assert sorted(tmp_path.iterdir()) == sorted(made[2:])


def test_a_robot_without_a_tracker_is_drawn_with_its_lowest_foot_on_the_ground():
    rig = load_rig("hexapod")
    scenario = Scenario("balance", 1.0, slope_roll=0.2, slope_pitch=-0.1)
    joints = np.random.default_rng(0).uniform(-0.3, 0.3, (4, 18))
    base = Ground(rig).base(joints, None, None, scenario)
    assert np.all(base[:, 2] > 0.02) and np.all(base[:, 2] < 0.3)
    again = Ground(rig).base(joints, None, None, Scenario("balance", 1.0))
    assert not np.allclose(base[:, 2], again[:, 2])
    assert np.linalg.norm(ground_normal(scenario)) == pytest.approx(1.0)


@pytest.mark.parametrize("name", ["hexapod", "servo_bench"])
def test_the_skeleton_has_every_joint_once_and_parents_before_children(name):
    rig = load_rig(name)
    drawn = skeleton(rig)
    turned = [b["joint"] for b in drawn["bodies"] if b["joint"] >= 0]
    assert sorted(turned) == list(range(len(rig.joint_names)))
    known = {0}
    for body in drawn["bodies"]:
        assert body["parent"] in known
        known.add(body["index"])
    assert all(shape["body"] in known for shape in drawn["shapes"])
    json.dumps(drawn)
