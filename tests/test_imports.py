"""Who imports whom: the layers of ARCHITECTURE.md, read from the source without running it.

Imports count wherever they stand: at the top, in functions, and for types alone.
"""

import ast
import functools
import re
from collections.abc import Collection, Iterator
from pathlib import Path

from .source import SOURCE, modules

ROOT = Path(__file__).parents[1]
# Rows of the table "Folders, and who imports whom": a layer and what is in it.
ROWS = re.findall(r"^\| (\d+) \| (`.+?`) \|", (ROOT / "ARCHITECTURE.md").read_text("utf-8"), re.M)
RANK = {name: int(layer) for layer, names in ROWS for name in re.findall("`(.+?)`", names)}
# `Capture` shows what is held out as well: these need it, or make a `TrainingCapture` of it.
SEE_EVERYTHING = set(
    "capture inspection synthesis evaluation benching film export view evsplat".split()
)
SEE_EVERYTHING |= {
    "masks.capture",
    "restore.capture",
    "posing.find",
    "importers.poses",
    "training.run",
    "training.train",
}
SEE_TRAINING_ALONE = set("body calibration gaussians models objectives methods".split())


def imports_of(module: str, tree: ast.Module) -> Iterator[tuple[str, str, str]]:
    """The module, one that it imports, and the name that it takes of that."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [entry.name for entry in node.names if entry.name.startswith("evsplat")]
            assert set(names) <= {"evsplat"}, f"{module}: write from ... import"
            yield from ((module, name, "") for name in names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}: a relative import"
            package, _, target = f"{node.module}".partition(".")
            for name in (entry.name for entry in node.names if package == "evsplat"):
                inner = f"{target}.{name}".lstrip(".")
                yield module, inner if inner in files() else target or "evsplat", name


def packages(module: str) -> list[str]:
    """The module and the packages around it, the innermost first."""
    parts = module.split(".")
    return [".".join(parts[:count]) for count in range(len(parts), 0, -1)]


def place(module: str, places: Collection[str]) -> str:
    """The innermost of ``places`` that the module is in; itself where it is in none."""
    return next((name for name in packages(module) if name in places), module)


@functools.cache
def files() -> dict[str, ast.Module]:
    """Modules by their dotted names in the package, and the package itself."""
    native = ast.parse((SOURCE / "_native.pyi").read_text("utf-8"))
    return {
        path.rpartition(".")[0].replace("/", ".").removesuffix("__init__").rstrip(".")
        or "evsplat": tree
        for path, tree in {**modules(), "_native.pyi": native}.items()
    }


@functools.cache
def imports() -> list[tuple[str, str, str]]:
    return [found for module, tree in files().items() for found in imports_of(module, tree)]


@functools.cache
def seers() -> set[str]:
    """Modules that import the whole capture."""
    return {
        module
        for module, target, name in imports()
        if name in ("Capture", "CaptureReader", "load_capture", "capture")
        or target in ("capture.capture", "capture.read")
    }


def files_run() -> dict[str, set[str]]:
    """Modules that Python runs for each module."""
    runs: dict[str, set[str]] = {module: set() for module in files()}
    for module, target, _ in imports():
        if target != "evsplat":
            # Python runs the packages around a module before it.
            runs[module] |= {target} | set(packages(target)) - set(packages(module))
    return runs


def circles(runs: dict[str, set[str]]) -> list[set[str]]:
    """Sets of names that reach each other, of a graph."""
    reached: dict[str, set[str]] = {name: set() for name in runs}
    for name, seen in reached.items():
        waiting = [name]
        while waiting:
            new = runs[waiting.pop()] - seen
            seen |= new
            waiting += new
    found = {frozenset(b for b in reached[a] if a in reached[b]) for a in runs}
    return [set(circle) for circle in found if circle]


def test_every_folder_has_a_layer_and_every_layer_a_folder():
    assert {place(module, RANK) for module in files()} == set(RANK)


def test_folders_import_from_lower_layers_alone():
    upward = {
        (module, target)
        for module, target, _ in imports()
        if target != "evsplat" and place(module, RANK) != place(target, RANK)
        if RANK[place(module, RANK)] <= RANK[place(target, RANK)]
    }
    assert upward == set()


def test_no_files_import_each_other_in_a_circle():
    assert circles(files_run()) == []


def test_modules_take_nothing_of_the_package_itself_but_its_version():
    nodes = [node for tree in files().values() for node in ast.walk(tree)]
    used = [node for node in nodes if isinstance(node, ast.Attribute)]
    taken = {node.attr for node in used if getattr(node.value, "id", "") == "evsplat"}
    taken |= {name for _, target, name in imports() if target == "evsplat" and name}
    assert taken == {"__version__"}


def test_what_training_is_made_of_never_imports_the_whole_capture():
    assert [name for name in seers() if place(name, SEE_TRAINING_ALONE) in SEE_TRAINING_ALONE] == []


def test_the_whole_capture_is_imported_where_it_is_needed_and_nowhere_else():
    assert {place(module, SEE_EVERYTHING) for module in seers()} == SEE_EVERYTHING
