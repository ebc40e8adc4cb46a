"""The documents say what the code is."""

import importlib.util
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").glob("*.md")])


@pytest.mark.parametrize("page", ["parameters", "effects"])
def test_the_pages_of_parameters_and_effects_are_written_from_the_code(page):
    written = (ROOT / "docs" / f"{page}.md").read_text()
    assert written == writer(page).text(), f"run: ./tcbi python docs/write_{page}.py"


def test_the_readme_names_every_parameter():
    readme = (ROOT / "README.md").read_text()
    assert readme == writer("parameters").with_overview(readme), "run: ./tcbi python docs/write_parameters.py"


def writer(page):
    """The script that writes a page."""
    spec = importlib.util.spec_from_file_location(f"write_{page}", ROOT / "docs" / f"write_{page}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_effect_that_the_page_shows_is_fit_for_use(tmp_path):
    from tcbi_sim.effect_check import check_file
    from tcbi_sim.rigs import RIGS

    (shown,) = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "effects.md").read_text(), re.DOTALL)
    file = tmp_path / "cable_spring.py"
    file.write_text(shown)
    check = check_file(file)
    assert check.faults == () and {t.rig for t in check.trials} == set(RIGS)


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


def test_the_files_that_the_examples_name_are_there():
    command = ROOT / "ros2_ws" / "src" / "tcbi_bringup" / "tcbi_bringup" / "commands" / "test.py"
    texts = [page.read_text() for page in (*PAGES, command)]
    named = {
        path for text in texts for path in re.findall(r"\b(?:ros2_ws/src|tests|docs|bench)/[\w/]+\.(?:py|md)\b", text)
    }
    assert len(named) > 5
    assert not [path for path in sorted(named) if not (ROOT / path).exists()]
