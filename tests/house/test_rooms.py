"""The rooms of the library: each imports only those before it, and modules of its own without a circle."""

import ast
import re
from graphlib import TopologicalSorter
from pathlib import Path

import switchfit as sf

PACKAGE = Path(sf.__file__).parent

LAYERS = (
    "arrays", "runtime", "optimize", "problem", "models", "discretization", "engine", "paper_adjoint", "meshes", "fit",
    "uncertainty", "strategy", "io", "report", "estimation", "batch", "modes", "online", "experiment_design", "paper",
    "cli", "__main__",
)  # fmt: skip
"""From the bottom to the top; the package itself, which collects what is public, is above them all."""

APART = {"optimize": {"arrays"}, "models": {"arrays", "problem"}}
"""Rooms that may import less than all before them."""


LOGS = {"arrays", "runtime", "problem.validation", "problem.dates", "problem.time_units"}
"""Rooms and modules of other rooms that `io.logs` may import: it knows no model, no fit and no report."""

OPTIONAL = {
    "gpxpy", "h5py", "pandas", "polars", "pyarrow", "pymap3d", "pynmea2", "rosbags",
    "xarray",
}  # fmt: skip
"""Libraries of the extras, which are imported where they are needed."""


def name_of(path: Path) -> str:
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {name_of(path): path for path in sorted(PACKAGE.rglob("*.py"))}


def imports_of(source: str) -> set[str]:
    """Every module of ours that a source imports, anywhere in it, for types too."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative import"
            base = node.module or ""
            wholes = (f"{base}.{a.name}" for a in node.names)
            found |= {whole if whole.removeprefix("switchfit.") in MODULES else base for whole in wholes}
        elif isinstance(node, ast.Import):
            found |= {a.name for a in node.names}
    return {name.removeprefix("switchfit").removeprefix(".") for name in found if name.split(".")[0] == "switchfit"}


def room_of(module: str) -> str:
    return module.split(".")[0]


def violations(module: str, imported: set[str]) -> list[str]:
    """Imports of rooms that come after the module's own, or that it may not know."""
    own = room_of(module)
    allowed = APART.get(own, set(LAYERS[: LAYERS.index(own)])) | {own}
    return [f"{module} imports {other or 'switchfit'}" for other in imported if room_of(other) not in allowed]


def test_each_room_imports_only_those_before_it():
    for module, path in MODULES.items():
        imported = imports_of(path.read_text())
        if room_of(module) == "cli":
            imported -= {""}  # it is a user of what is public
        assert not module or not violations(module, imported)


def test_logs_are_read_without_the_rest_of_the_library():
    modules = {name: path for name, path in MODULES.items() if name.startswith("io.logs")}
    assert len(modules) > 5
    for name, path in modules.items():
        foreign = {other for other in imports_of(path.read_text()) if not other.startswith("io.logs")}
        assert all(other.rpartition(".")[0] in LOGS or other in LOGS or room_of(other) in LOGS for other in foreign), (
            f"{name}: {foreign}"
        )


def test_libraries_of_the_extras_are_imported_where_they_are_needed():
    for name, path in MODULES.items():
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.Import | ast.ImportFrom):
                imported = [a.name for a in node.names] if isinstance(node, ast.Import) else [node.module or ""]
                assert not OPTIONAL & {other.partition(".")[0] for other in imported}, name


def test_no_module_imports_itself_by_way_of_others():
    graph = {module: imports_of(path.read_text()) - {module, ""} for module, path in MODULES.items() if module}
    list(TopologicalSorter(graph).static_order())  # raises CycleError


def test_every_room_is_in_the_list_and_says_what_belongs_in_it():
    rooms = {room_of(name) for name in MODULES if name}
    assert rooms == set(LAYERS)
    for room in rooms:
        source = MODULES[room].read_text()
        assert ast.get_docstring(ast.parse(source)), room


def test_only_what_is_public_is_shown_and_no_verb_is_a_module():
    assert dir(sf) == sorted([*sf.__all__, "__version__"])
    verbs = {name for name in sf.__all__ if name.islower()}
    assert len(verbs) > 10
    assert not verbs & {part for name in MODULES for part in name.split(".")}


def test_the_page_of_internals_has_the_rooms_in_this_order():
    page = (Path(__file__).parents[2] / "docs" / "internals.md").read_text()
    rooms = re.findall(r"^\| `(\w+)` \|", page[: page.index("## Data flow")], re.MULTILINE)
    assert rooms == [room for room in LAYERS if room != "__main__"]
