"""Imports flow one way: a folder may import from floors below its own, and from nothing beside it."""

import ast
from pathlib import Path

import pytest

import foredrive

ROOT = Path(foredrive.__file__).parent

FLOORS = [
    {"geometry"},
    {"scene", "ops"},
    {"sensors", "sets"},
    {"data"},
    {"engine"},
    {"heads"},
    {"tasks"},
    {"methods"},
    {"driving"},
    {"towns"},
    {"search"},
    {"driver"},
    {"integrations"},
    {"runs"},
    {"view"},
    {"cli"},
]
THIRD_PARTY_ONLY_IN = {"py123d": {"data", "towns"}, "carla": set[str]()}
"""CARLA's client is imported by name in one place, and late: `integrations/carla/client.py`."""

FLOOR_OF = {folder: level for level, floor in enumerate(FLOORS) for folder in floor}


def imported_modules(path: Path) -> set[str]:
    """Every module a file imports, at any depth of the file."""
    modules: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            modules |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            modules.add(node.module or "")
    return modules


def arrows() -> set[tuple[str, str, Path]]:
    """(importing folder, imported folder, file) over the whole package."""
    found = set()
    for path in ROOT.rglob("*.py"):
        if path == ROOT / "__main__.py":  # the door, above everything
            continue
        folder = path.relative_to(ROOT).parts[0] if path.parent != ROOT else "."
        for module in imported_modules(path):
            parts = module.split(".")
            if parts[0] == "foredrive" and len(parts) > 1 and parts[1] in FLOOR_OF and parts[1] != folder:
                found.add((folder, parts[1], path))
    return found


def allowed(source: str, target: str) -> bool:
    if source == ".":  # the root's own modules stand below every folder
        return False
    return FLOOR_OF[target] < FLOOR_OF[source]


def test_every_folder_has_a_floor() -> None:
    folders = {p.name for p in ROOT.iterdir() if p.is_dir() and p.name != "__pycache__"}
    assert folders <= set(FLOOR_OF), (
        f"give {folders - set(FLOOR_OF)} a floor in docs/architecture.md and here"
    )
    assert "utils" not in folders


def test_imports_flow_downwards() -> None:
    wrong = [
        f"{path}: {source} -> {target}" for source, target, path in arrows() if not allowed(source, target)
    ]
    assert not wrong, "\n".join(wrong)


def test_the_rule_catches_an_arrow_that_runs_back_up() -> None:
    assert allowed("methods", "tasks")
    assert allowed("towns", "driving")
    assert not allowed("tasks", "methods")
    assert not allowed("driving", "towns")
    assert not allowed("engine", "engine")


def test_third_party_packages_stay_where_they_belong() -> None:
    wrong = []
    for path in ROOT.rglob("*.py"):
        folder = path.relative_to(ROOT).parts[0]
        for module in imported_modules(path):
            homes = THIRD_PARTY_ONLY_IN.get(module.split(".")[0])
            if homes is not None and folder not in homes:
                wrong.append(f"{path} imports {module}")
    assert not wrong, "\n".join(wrong)


INNER_FLOORS = {
    "towns": [{"map"}, {"traffic", "place"}, {"sensing"}, {"labels"}, {"driving"}],
    "methods": [
        {"blocks"},
        {"planner", "reconstruction"},
        {"nemo", "splatad", "lidarclip"},
        {"driveworld", "neurad"},
    ],
    "data": [{"formats", "truth"}],
    "tasks": [
        {"files"},
        {"objects", "planning", "rendering"},
        {"detection", "maps", "occupancy"},
        {"tracking", "motion"},
        {"evaluation"},
    ],
}
"""Folders of a folder. What lies beside them joins them.

Traffic knows nothing of looks. NeMo and DriveWorld share a planner, and DriveWorld begins at NeMo's recipes.
A neural field takes up Gaussians that are put into it.
"""


@pytest.mark.parametrize("folder", INNER_FLOORS)
def test_imports_flow_downwards_within(folder: str) -> None:
    level = {inner: i for i, floor in enumerate(INNER_FLOORS[folder]) for inner in floor}
    wrong = []
    for inner, floor in level.items():
        for path in (ROOT / folder / inner).rglob("*.py"):
            for module in imported_modules(path):
                other = module.removeprefix(f"foredrive.{folder}.").split(".")[0]
                if other in level and other != inner and level[other] >= floor:
                    wrong.append(f"{path} imports {module}")
    assert not wrong, "\n".join(wrong)


def foredrive_files(path: Path) -> set[Path]:
    """The files of the package that a file imports, at any depth of the file."""
    found = set()
    for module in imported_modules(path):
        if module.startswith("foredrive."):
            place = ROOT.joinpath(*module.split(".")[1:])
            found.add(
                place.with_suffix(".py") if place.with_suffix(".py").exists() else place / "__init__.py"
            )
    return found


def test_no_two_files_import_each_other() -> None:
    """Not even late, or for their types alone: who reads one would have to know the other first."""
    of = {path: foredrive_files(path) - {path} for path in ROOT.rglob("*.py") if path.name != "__init__.py"}
    assert [(a, b) for a, others in of.items() for b in others if a in of.get(b, ())] == []


def test_carla_is_driven_in_without_the_embedded_towns() -> None:
    todo, reached = set((ROOT / "integrations" / "carla").rglob("*.py")), set[Path]()
    while todo:
        reached |= todo
        todo = {other for path in todo for other in foredrive_files(path)} - reached
    names = {path.relative_to(ROOT).as_posix() for path in reached}
    assert "driving/lane_rules.py" in names
    assert not {name for name in names if name.startswith("towns/")}
    source = foredrive_files(ROOT / "runs" / "drive" / "in_carla.py")
    assert not source & {ROOT / "towns" / "driving" / "town.py", ROOT / "runs" / "drive" / "in_towns.py"}


NO_NOUNS = {"found", "at", "each", "there", "told"}


@pytest.mark.parametrize("path", sorted(ROOT.rglob("*.py")), ids=lambda path: str(path.relative_to(ROOT)))
def test_variables_arguments_and_fields_are_named_by_nouns(path: Path) -> None:
    """A reader cannot guess what `found` holds. A method may be called `at`: `trajectory.at(t_s)`."""
    nodes = list(ast.walk(ast.parse(path.read_text())))
    variables = {node.id for node in nodes if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)}
    fields = {
        node.attr for node in nodes if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store)
    }
    arguments = {node.arg for node in nodes if isinstance(node, ast.arg)}
    assert not NO_NOUNS & (variables | fields | arguments)
