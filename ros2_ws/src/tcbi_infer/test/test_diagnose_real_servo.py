"""Real recordings of a servo: load-dependent friction helps on a trajectory no fit saw; no cause is claimed."""

import os
from pathlib import Path

import pytest

from tcbi_infer.diagnose import diagnose
from tcbi_infer.importer import read_log
from tcbi_infer.mapping import load_mapping
from tcbi_sim.model import base_model

ROOT = Path(__file__).resolve().parents[4]
DATA = Path(os.environ.get("TCBI_DATA", ROOT.parent / "shared" / "data")) / "xl330_pendulum"


@pytest.mark.real_data
@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.skipif(not DATA.is_dir(), reason=f"no recordings at {DATA}; set TCBI_DATA")
def test_load_dependent_friction_lowers_the_error_on_a_trajectory_no_fit_saw():
    mapping = load_mapping("xl330_bench")
    recordings = [read_log(mapping, path) for path in sorted(DATA.glob("*.json"))]
    diagnosis = diagnose(base_model("motor_bench"), recordings, uses=["load_friction"])
    (friction,) = diagnosis.ranking
    assert len(diagnosis.sealed) == 3  # one trajectory at each of the servo's three gains
    assert friction.error_after < 0.75 * friction.error_before
    assert diagnosis.verdict != "nothing_missing"
    assert any("no false-alarm rate is claimed" in claim for claim in diagnosis.claims)
