"""The documents say what the code is."""

import importlib.util
import json
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / "ros2_ws" / "src"
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


@pytest.mark.parametrize("what", ["Topics", "Services and actions"])
def test_the_contract_lists_what_the_code_names_and_nothing_else(what):
    module = (SOURCE / "tcbi_contract" / "tcbi_contract" / "names.py").read_text()
    named = re.findall(r'^[A-Z_]+ = "(\S+)"', module.partition(f"\n# {what}")[2].partition("\n\n")[0], re.MULTILINE)
    page = (ROOT / "docs" / "contract.md").read_text().partition(f"\n## {what}\n")[2].partition("\n## ")[0]
    first_cells = re.findall(r"^\| (`[^|]*`) \|", page, re.MULTILINE)
    listed = [name for cell in first_cells for name in re.findall(r"`([^`]+)`", cell)]
    assert len(named) > 10
    assert sorted(listed) == sorted(named)


def test_no_node_has_a_name_of_its_own_for_a_topic_service_or_action():
    makers = r"create_(?:publisher|subscription|service|client)\(|Action(?:Server|Client)\(\s*self,"
    literal = re.compile(rf"(?:{makers})\s*[\w.]+,\s*f?[\"']")
    assert literal.search('self.create_publisher(Clock, "/clock", 10)')
    files = [file for file in SOURCE.glob("*/*/**/*.py") if re.search(makers, file.read_text())]
    assert len(files) > 8
    assert not [file.name for file in files if literal.search(file.read_text())]


def test_every_node_tells_its_health():
    nodes = {file.stem: file.read_text() for file in SOURCE.glob("*/*/**/*_node.py")}
    processes = {name: text for name, text in nodes.items() if "\ndef main(" in text}
    assert len(processes) > 8
    assert not {name for name, text in processes.items() if "create_publisher(DiagnosticArray," not in text}


def test_the_files_that_the_examples_name_are_there():
    command = ROOT / "ros2_ws" / "src" / "tcbi_bringup" / "tcbi_bringup" / "commands" / "test.py"
    texts = [page.read_text() for page in (*PAGES, command)]
    named = {
        path for text in texts for path in re.findall(r"\b(?:ros2_ws/src|tests|docs|bench)/[\w/]+\.(?:py|md)\b", text)
    }
    assert len(named) > 5
    assert not [path for path in sorted(named) if not (ROOT / path).exists()]


@pytest.mark.parametrize(("task", "thousand", "metres"), [("balance", 1.0, False), ("forward", 1000.0, True)])
def test_the_tables_of_the_study_s_page_are_those_of_its_results(task, thousand, metres):
    found = json.loads((ROOT / "docs" / "study.json").read_text())["tasks"][task]
    page = (ROOT / "docs" / "study.md").read_text()
    gains = {row["name"]: row for row in found["comparisons"]}
    stiffness = {row["name"]: row for row in found["variance_reduction"] if row["parameter"] == "gain"}
    inside = {
        row["name"]: [r for r in found["variance_reduction"] if r["name"] == row["name"]] for row in found["noise"]
    }
    loudest = max(row["sigma"] for row in found["noise"])
    noise = {row["name"]: row["return"] for row in found["noise"] if row["sigma"] == loudest}
    for row in found["performance"]:
        name = row["name"]

        def spread(of, what, prefix=""):
            value, *ends = (f"{of[prefix + what + end] / thousand:.0f}" for end in ("", "_low95", "_high95"))
            return f"{value} ({ends[0]} to {ends[1]})"

        place = f"{row['distance_cm'] / 100:.1f}" if metres else f"{row['inclination_deg']:.1f}"
        cells = [row["label"], spread(row, "return"), place]
        cells += [spread(gains[name], "returns", "gain_") if name in gains else "", f"{row['divergence_nats']:.3f}"]
        if name in stiffness:
            told = stiffness[name]
            cells += [f"{100 * told['variance_reduction']:.0f} %, {100 * told['relative_error']:.0f} %"]
            tried = sum(r["robots"] for r in inside[name])
            cells += [f"{sum(r['truth_in_90'] for r in inside[name])} of {tried}", f"{noise[name] / thousand:.0f}"]
        else:
            cells += ["", "", ""]
        line = "| " + " | ".join(cells) + " |"
        assert line.replace("-0 %", "0 %") in page, line
