"""Real recordings: the error on what no fit has seen falls with the effects that the bench and the diagnosis name."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from tcbi_infer.diagnose import diagnose
from tcbi_infer.diagnose.settings import QUICK
from tcbi_infer.importer import logs_in, read_rollouts

BENCH = Path(__file__).resolve().parents[1] / "bench" / "real_data.py"

pytestmark = pytest.mark.real_data


@pytest.fixture
def bench(real_data, monkeypatch) -> ModuleType:
    spec = importlib.util.spec_from_file_location("real_data_bench", BENCH)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, spec.name, module)
    spec.loader.exec_module(module)
    monkeypatch.setattr(module, "DATA", real_data)
    return module


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_load_friction_lowers_the_servos_error_on_the_trajectory_held_out_first(bench):
    *errors, ratio = bench.pendulum(bench.TRAJECTORY, quick=True)
    held = "xl330: lift_and_drop held out"
    assert [f["name"] for f in errors] == [f"{held}, base", f"{held}, load_friction"]
    assert ratio["value"] < 0.75, "on this trajectory alone; over all four there is more (docs/real_data.md)"


@pytest.mark.timeout(300)
def test_the_elbow_droops_and_sticks_but_wrist_roll_and_jaw_do_not_droop(bench):
    """With values chosen on other motions (docs/real_data.md), on a minute each of two that they were not chosen on."""
    effort = bench.Effort()
    mapping = bench.load_mapping("so101_arm")
    logs = [bench.DATA / "so101_arm" / name for name in ("step_response", "backlash_detection")]
    unseen = bench.Data([bench.pieces(bench.read_log(mapping, log), 60.0)[0] for log in logs], effort)

    def error(effects, *values):
        model = bench.base_model("so101_arm")
        for effect in effects:
            model = model.with_effect(effect)
        return np.sqrt(np.mean(unseen.residuals(model, np.array([values]))[0] ** 2, axis=0))

    elbow, loadless = 2, [4, 5]
    lag = error((), 0.104)
    both = error(("gravity_droop:Elbow", "load_friction"), 0.099, 0.039, 0.692)
    drooping = error(("gravity_droop:Wrist_Roll", "gravity_droop:Jaw"), 0.104, 0.09, 0.09)
    assert np.degrees(both[elbow]) < 0.5 * bench.ideal_servo(unseen)[elbow]
    assert both[elbow] < 0.5 * lag[elbow]
    assert (drooping[loadless] > 0.98 * lag[loadless]).all()


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_diagnosis_of_the_double_pendulum_ranks_coulomb_friction_first_of_the_whole_library(bench):
    mapping = bench.load_mapping("double_pendulum")
    logs = logs_in([bench.DATA / "double_pendulum"], mapping)
    found = diagnose(
        bench.base_model("double_pendulum"), [p for log in logs for p in read_rollouts(mapping, log)], settings=QUICK
    )
    assert found.uses == ("coulomb_friction",), f"alone, though not always as certain: {found.statement}"
    best = found.ranking[0]
    assert min(best.gains) > 0, "each of the five runs is predicted better, without having been fitted"
    assert best.error_after < 0.6 * best.error_before
    torque = best.parameters[0]
    assert 0.08 < torque.value < 0.15 and torque.excludes_null, "0.09 N m is what the builders published"
