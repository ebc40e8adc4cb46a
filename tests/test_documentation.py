"""The documents say what the code is."""

import importlib.util
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").glob("*.md")])


def test_the_page_of_parameters_is_written_from_the_nodes():
    spec = importlib.util.spec_from_file_location("write_parameters", ROOT / "docs" / "write_parameters.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    written = (ROOT / "docs" / "parameters.md").read_text()
    assert written == module.text(), "run: ./tcbi python docs/write_parameters.py"


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_every_link_to_a_file_leads_somewhere(page):
    links = re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", page.read_text())
    missing = [link for link in links if "://" not in link and not (page.parent / link).exists()]
    assert not missing


def test_the_topics_of_the_contract_are_those_of_the_code():
    from tcbi_contract import names

    text = (ROOT / "docs" / "contract.md").read_text()
    topics = ("JOINT_STATES", "IMU", "FOOT_CONTACTS", "JOINT_COMMANDS", "TRACKER_POSE", "ROLLOUT_EVENT", "DIAGNOSTICS")
    more = ("ROBOT_DESCRIPTION", "POSTERIOR", "MODEL_ERROR", "DIAGNOSIS", "RESET_EPISODE", "EMERGENCY_STOP", "RETRAIN")
    missing = [name for name in (*topics, *more) if f"`{getattr(names, name)}`" not in text]
    assert not missing
