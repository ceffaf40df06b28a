"""The rooms of the package, in the order of the data: imports run one way."""

import ast
from pathlib import Path

import pytest

import rov_ident

ORDER = (
    "core reports model effects config io simulation sampling estimation offline discrepancy "
    "experiment steering consumer api dashboard nodes cli"
).split()
"""A room imports only from rooms before it; ARCHITECTURE.md shows the same list."""

ROOT = Path(rov_ident.__file__).parent
FILES = sorted(ROOT.rglob("*.py"))
ROS = {"rclpy", "rosgraph_msgs", "rcl_interfaces", "diagnostic_msgs", "nav_msgs", "sensor_msgs"}
ROS |= {"geometry_msgs", "std_msgs", "std_srvs", "builtin_interfaces", "ament_index_python"}
KNOWN_TO = dict.fromkeys(ROS, "nodes") | {
    "mcap": "io",
    "numba": "core/jit.py",
    "llvmlite": "core/jit.py",
    "matplotlib": "reports",
}
"""Which room, or file of it, alone imports a package."""


def imported(path: Path) -> set[str]:
    """Every module that a file imports, anywhere in it, for types, too."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {name.name for name in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"{path}: imports are written in full"
            found |= {f"{node.module}.{name.name}" for name in node.names}
    return found


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_run_one_way(path):
    room, *inside = path.relative_to(ROOT).parts
    names = {tuple(name.split(".")) for name in imported(path)}
    if not inside:
        assert room in ("__init__.py", "__main__.py"), f"{room} belongs in a room"
        return
    above = ORDER[ORDER.index(room) + 1 :]
    assert not {name for name in names if name[0] == "rov_ident" and name[1] in above}
    place = path.relative_to(ROOT).as_posix()
    packages = {name[0] for name in names} & KNOWN_TO.keys()
    assert all(place.startswith(KNOWN_TO[package]) for package in packages)


def test_rooms_are_the_folders_and_the_architecture_shows_them_in_this_order():
    folders = {path.name for path in ROOT.iterdir() if (path / "__init__.py").exists()}
    assert folders == set(ORDER)
    text = (ROOT.parent / "ARCHITECTURE.md").read_text()
    places = [text.index(f"| `{room}/` |") for room in ORDER]
    assert places == sorted(places)
    for room in ORDER:
        doc = ast.get_docstring(ast.parse((ROOT / room / "__init__.py").read_text()))
        assert doc and len(doc.splitlines()) >= 3, f"{room}/__init__.py says what it knows"
