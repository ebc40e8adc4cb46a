"""The emulated robot shares the drawing with the model, and no line of code."""

import ast
import subprocess
import sys
from pathlib import Path

import tcbi_bringup.emulated_robot as package

FOLDER = Path(package.__file__).parent
MODULES = sorted(path for path in FOLDER.rglob("*.py") if path.stem != "as_measurement")
TYPES_ONLY = {"Commands", "Measurement", "Scenario"}


def imported(path: Path) -> set[str]:
    """Names of the modules that a file imports."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names.add(node.module or "")
    return names


def test_no_module_imports_the_model() -> None:
    assert len(MODULES) > 10
    for path in MODULES:
        assert not [name for name in imported(path) if name.split(".")[0] == "tcbi_sim"], path.name


def test_the_adapter_takes_types_alone() -> None:
    tree = ast.parse((FOLDER / "as_measurement.py").read_text())
    taken = {
        alias.name
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("tcbi_sim")
        for alias in node.names
    }
    assert taken == TYPES_ONLY


def test_a_rollout_loads_nothing_of_the_model_and_no_ros() -> None:
    code = (
        "import sys, numpy as np\n"
        "from tcbi_bringup.emulated_robot.rollout import EmulatedRobot, Script\n"
        "from tcbi_bringup.emulated_robot.mechanics import Scene\n"
        "EmulatedRobot(1).rollout(Scene(), 0.1, Script(np.zeros(1), np.zeros((1, 18))), settle=0.05)\n"
        "print([m for m in sys.modules if m.split('.')[0] in ('tcbi_sim', 'rclpy')])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.strip() == "[]"
