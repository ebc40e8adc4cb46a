"""What holds between packages: dependencies point one way, pure modules need no ROS, nothing names this machine."""

import ast
import glob
import os
import re
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / "ros2_ws" / "src"
ALLOWED = {
    "tcbi_contract": {"tcbi_msgs"},
    "hexapod_driver": {"tcbi_msgs", "tcbi_contract"},
    "tcbi_sim": {"tcbi_msgs", "tcbi_contract"},
    "tcbi_policy": {"tcbi_msgs", "tcbi_contract", "tcbi_sim"},
    "tcbi_infer": {"tcbi_msgs", "tcbi_contract", "tcbi_sim", "tcbi_policy"},
    "tcbi_dashboard": {"tcbi_msgs", "tcbi_contract", "tcbi_sim", "tcbi_policy", "tcbi_infer"},
    "tcbi_bringup": {
        *("tcbi_msgs", "tcbi_contract", "tcbi_sim", "tcbi_policy", "tcbi_infer", "tcbi_dashboard", "hexapod_driver"),
    },
}
OWN = {*ALLOWED, "tcbi_msgs"}
ROS = {
    *(
        "rclpy",
        "tcbi_msgs",
        "std_msgs",
        "std_srvs",
        "sensor_msgs",
        "geometry_msgs",
        "trajectory_msgs",
        "diagnostic_msgs",
    ),
    *("rosgraph_msgs", "builtin_interfaces", "rcl_interfaces", "action_msgs"),
}


def modules(package: str) -> dict[str, Path]:
    """Dotted name and file of each module of a package."""
    folder = SOURCE / package
    files = sorted((folder / package).rglob("*.py"))
    return {".".join(f.relative_to(folder).with_suffix("").parts).removesuffix(".__init__"): f for f in files}


def imported(file: Path, top_level: bool = False) -> set[str]:
    """Modules that a file imports: anywhere, or on being imported itself."""
    found: set[str] = set()
    todo: list[ast.AST] = [ast.parse(file.read_text(encoding="utf-8"))]
    while todo:
        node = todo.pop()
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
        if top_level and isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)):
            continue
        if top_level and isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            todo.extend(node.orelse)
            continue
        todo.extend(ast.iter_child_nodes(node))
    return found


def packages_of(names: set[str]) -> set[str]:
    return {name.partition(".")[0] for name in names}


def declared(package: str, *tags: str) -> set[str]:
    """Names in package.xml under the given tags."""
    root = ET.parse(SOURCE / package / "package.xml").getroot()
    return {element.text or "" for tag in tags for element in root.iter(tag)}


@pytest.mark.parametrize("package", sorted(ALLOWED))
def test_a_package_imports_only_those_below_it(package):
    wrong = {
        f"{name} imports {other}"
        for name, file in modules(package).items()
        for other in packages_of(imported(file)) & OWN - ALLOWED[package] - {package}
    }
    assert not wrong


@pytest.mark.parametrize("package", sorted(ALLOWED))
def test_what_is_imported_from_the_workspace_is_declared(package):
    used = set().union(*(packages_of(imported(file)) for file in modules(package).values()))
    needed = (used & (OWN | ROS)) - {package}
    assert needed <= declared(package, "depend", "exec_depend")


def ros_modules() -> set[str]:
    """Modules that import ROS themselves or through another module of the project."""
    edges = {name: imported(file, top_level=True) for p in ALLOWED for name, file in modules(p).items()}
    found = {name for name, used in edges.items() if packages_of(used) & ROS}
    while more := {name for name, used in edges.items() if name not in found and used & found}:
        found |= more
    return found


def test_a_module_that_imports_ros_is_a_node_or_says_so_in_its_first_words():
    stray = {
        name
        for package in ALLOWED
        for name, file in modules(package).items()
        if packages_of(imported(file, top_level=True)) & ROS and not name.endswith("_node")
        if "needs ROS" not in (ast.get_docstring(ast.parse(file.read_text(encoding="utf-8"))) or "")
    }
    assert not stray, "put what needs ROS into a node file; an adapter beside one says `needs ROS` in its docstring"


def test_all_other_modules_import_with_rclpy_blocked():
    pure = sorted({n for p in ALLOWED for n in modules(p) if not n.endswith("__main__")} - ros_modules())
    code = (
        "import importlib, sys\n"
        "class Block:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name.partition('.')[0] in set(sys.argv[1].split()): raise ImportError(f'{name} is blocked')\n"
        "sys.meta_path.insert(0, Block())\n"
        "failed = []\n"
        "for name in sys.argv[2:]:\n"
        "    try: importlib.import_module(name)\n"
        "    except Exception as e: failed.append(f'{name}: {e!r}')\n"
        "print('\\n'.join(failed)); sys.exit(bool(failed))\n"
    )
    command = [sys.executable, "-P", "-c", code, " ".join(ROS), *pure]
    result = subprocess.run(command, capture_output=True, text=True, timeout=110, check=False)
    assert result.returncode == 0, result.stdout + result.stderr


def text_files() -> list[Path]:
    """What is part of the product, as text."""
    folders = [ROOT / f for f in ("ros2_ws/src", "tcbi_setup", "docs", "tests", "bench", ".ci")]
    kinds = {".py", ".md", ".toml", ".xml", ".cfg", ".txt", ".msg", ".srv", ".action", ".html", ".in", ".lock", ".yaml"}
    inside = [f for folder in folders if folder.is_dir() for f in folder.rglob("*") if f.is_file()]
    return [f for f in (*ROOT.iterdir(), *inside) if f.is_file() and (f.suffix in kinds or f.name in ("tcbi", "run"))]


def test_no_file_names_a_path_of_the_machine_that_made_it():
    homes = ("/" + "work/", "/" + "root/", "/" + "tmp/", "/" + "home/", "/" + "Users/")
    found = [
        f"{file.relative_to(ROOT)}:{number}: {line.strip()[:80]}"
        for file in text_files()
        for number, line in enumerate(file.read_text(encoding="utf-8").splitlines(), 1)
        if any(home in line for home in homes)
    ]
    assert not found


def test_locks_name_versions_and_no_address():
    for lock in sorted(ROOT.glob("requirements*.lock")):
        lines = lock.read_text(encoding="utf-8").splitlines()
        assert not [line for line in lines if "://" in line or " @ " in line], lock.name
        assert not [line for line in lines if line[:1].isalnum() and "==" not in line], lock.name


@pytest.mark.parametrize("package", sorted(ALLOWED))
def test_a_package_is_what_ros_expects(package):
    folder = SOURCE / package
    assert (folder / "resource" / package).is_file()
    setup = (folder / "setup.cfg").read_text(encoding="utf-8")
    assert f"script_dir=$base/lib/{package}" in setup and f"install_scripts=$base/lib/{package}" in setup
    assert "executable=/usr/bin/env python3" in setup, "apt's colcon would write /usr/bin/python3, which sees no venv"
    data_files = (folder / "setup.py").read_text(encoding="utf-8")
    assert f'("share/ament_index/resource_index/packages", ["resource/{package}"])' in data_files
    assert f'("share/{package}", ["package.xml"])' in data_files
    root = ET.parse(folder / "package.xml").getroot()
    assert root.get("format") == "3"
    assert root.findtext("name") == package
    assert root.findtext("export/build_type") == "ament_python"
    assert root.findtext("license") == "Apache-2.0"


@pytest.mark.parametrize("package", sorted(ALLOWED))
def test_each_folder_of_modules_is_a_python_package(package):
    folders = {file.parent for file in (SOURCE / package / package).rglob("*.py")}
    assert not [str(f.relative_to(SOURCE)) for f in sorted(folders) if not (f / "__init__.py").is_file()]


def setup_keywords(package: str) -> dict[str | None, ast.expr]:
    """What setup.py hands to `setup`."""
    tree = ast.parse((SOURCE / package / "setup.py").read_text(encoding="utf-8"))
    call = next(n for n in ast.walk(tree) if isinstance(n, ast.Call) and getattr(n.func, "id", "") == "setup")
    return {keyword.arg: keyword.value for keyword in call.keywords}


def console_scripts(package: str) -> dict[str, str]:
    """Name and `module:function` of each executable in setup.py."""
    keywords = setup_keywords(package)
    points = ast.literal_eval(keywords["entry_points"]) if "entry_points" in keywords else {}
    return dict(re.split(r"\s*=\s*", line) for line in points.get("console_scripts", []))


@pytest.mark.parametrize("package", sorted(ALLOWED))
def test_each_executable_names_a_function_that_is_there(package):
    known = modules(package)
    for name, target in console_scripts(package).items():
        module, _, function = target.partition(":")
        body = ast.parse(known[module].read_text(encoding="utf-8")).body
        assert function in {n.name for n in body if isinstance(n, ast.FunctionDef)}, name


@pytest.mark.parametrize("package", sorted(ALLOWED))
def test_each_executable_and_marker_is_in_the_install_space(package):
    index = pytest.importorskip("ament_index_python.packages", reason="no ROS in this shell; ./tcbi python has one")
    try:
        prefix = Path(index.get_package_prefix(package))
    except index.PackageNotFoundError:
        pytest.skip(f"{package} is not built in this shell; ./tcbi builds it")
    folder = prefix / "lib" / package
    found = {file.name for file in folder.glob("*") if os.access(file, os.X_OK)}
    assert found == set(console_scripts(package))
    assert (prefix / "share" / package / "package.xml").is_file()


def test_the_packages_with_executables_are_those_that_the_launcher_and_doctor_know():
    tree = ast.parse(modules("tcbi_bringup")["tcbi_bringup.executables"].read_text(encoding="utf-8"))
    listed = next(
        ast.literal_eval(n.value)
        for n in tree.body
        if isinstance(n, ast.Assign) and ast.unparse(n.targets[0]) == "PACKAGES"
    )
    assert set(listed) == {package for package in ALLOWED if console_scripts(package)}


def test_every_interface_file_is_generated():
    folder = SOURCE / "tcbi_msgs"
    files = {f"{f.parent.name}/{f.name}" for kind in ("msg", "srv", "action") for f in folder.glob(f"{kind}/*.{kind}")}
    assert files == set(re.findall(r"\b(?:msg|srv|action)/\w+\.\w+", (folder / "CMakeLists.txt").read_text("utf-8")))
    assert "rosidl_interface_packages" in declared("tcbi_msgs", "member_of_group")


ROSDEP_KEYS = {  # by the name imported; each is a system package of Ubuntu 24.04 or a package of Jazzy
    "numpy": "python3-numpy",
    "scipy": "python3-scipy",
    "serial": "python3-serial",
    "yaml": "python3-yaml",
    "jinja2": "python3-jinja2",
    "netCDF4": "python3-netcdf4",
    "psutil": "python3-psutil",
    "h5py": "python3-h5py",
    "pytest": "python3-pytest",
    "hypothesis": "python3-hypothesis",
    "ament_index_python": "ament_index_python",
}
PYPI_NAMES = {"scservo_sdk": "feetech_servo_sdk", "crcmod": "crcmod_plus"}  # where they differ from those imported


def undeclared(used: set[str], keys: set[str]) -> set[str]:
    """Imports with neither a rosdep key among `keys` nor a line in the list of PyPI."""
    lines = (ROOT / "ros2_ws" / "requirements-pypi.txt").read_text(encoding="utf-8").splitlines()
    listed = {re.split(r"[=<>;\s]", line)[0].replace("-", "_") for line in lines if line[:1].isalnum()}
    listed -= set(ROSDEP_KEYS)
    others = used - OWN - ROS - set(sys.stdlib_module_names)
    return {n for n in others if ROSDEP_KEYS.get(n) not in keys and PYPI_NAMES.get(n, n) not in listed}


@pytest.mark.parametrize("package", sorted(ALLOWED))
def test_every_other_import_has_a_rosdep_key_or_stands_in_the_list_of_pypi(package):
    used = set().union(*(packages_of(imported(file)) for file in modules(package).values()))
    missing = undeclared(used, declared(package, "depend", "exec_depend"))
    assert not missing, "declare it in package.xml, or in ros2_ws/requirements-pypi.txt where rosdep has no key"


@pytest.mark.parametrize("package", sorted(ALLOWED))
def test_so_has_every_import_of_a_packages_tests(package):
    files = list((SOURCE / package / "test").glob("*.py"))
    used = set().union(*(packages_of(imported(file, top_level=True)) for file in files)) - {file.stem for file in files}
    assert not undeclared(used, declared(package, "depend", "exec_depend", "test_depend"))


@pytest.mark.parametrize("package", sorted(ALLOWED))
def test_a_build_installs_every_data_file_of_a_package(package):
    """Without --symlink-install only what package_data matches is there."""
    folder = SOURCE / package / package
    patterns = ast.literal_eval(setup_keywords(package)["package_data"])[package]
    matched = {Path(f) for pattern in patterns for f in glob.glob(str(folder / pattern), recursive=True)}
    files = {f for f in folder.rglob("*") if f.is_file() and f.parent.name != "__pycache__" and f.suffix != ".py"}
    assert not sorted(str(f.relative_to(folder)) for f in files - matched)


@pytest.mark.parametrize("package", sorted(OWN))
def test_rosdep_installs_every_dependency_from_apt(package):
    tags = ("depend", "exec_depend", "buildtool_depend", "build_depend", "test_depend")
    tools = {"ament_cmake", "rosidl_default_generators", "rosidl_default_runtime"}
    unknown = declared(package, *tags) - OWN - ROS - set(ROSDEP_KEYS.values()) - tools
    assert not unknown, "a key of pip (-pip) fails on Ubuntu 24.04, whose Python refuses packages that are not apt's"
