"""Who imports whom: the layers of ARCHITECTURE.md, read from the source without running it."""

import ast
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

SOURCE = Path(__file__).parents[1] / "src" / "evsplat"
ROOT = "evsplat"

# From low to high: a folder imports from itself and from lines above its own, not from its line.
LAYERS = """
    _native cuda_support errors
    compiled devices files names safe_pickle shipped weights
    config neighbours
    imaging render similarity
    events
    body calibration
    capture
    footage gaussians masks restore staging
    deform synthesis
    capture.importers objectives
    hugs
    methods
    training
    evaluation
    benching film
    export
    view
    cli
    evsplat __main__
"""
RANK = {name: rank for rank, line in enumerate(LAYERS.split("\n")) for name in line.split()}

# Imports of a higher layer that are left; take a line away with its import.
EXCEPTIONS = {
    ("body.adapters", "capture.body_file"),  # its type alone
    ("body.silhouette", "capture.camera"),  # its type alone
    ("body.track", "capture"),  # types alone: `load_body_track` takes a capture
    ("calibration", "capture"),  # its type alone: `estimate_from_capture` takes a capture
    ("imaging.edi", "events.maps"),  # a deblurring by events, in a folder of arithmetic on light
    ("imaging.edi", "events.stream"),
    ("evaluation.report.clip", "export.video"),  # inside a function: the clip is a video
}
# Files that need each other, as soon as they are imported and later; these too may only shrink.
KNOTS = [{"events", "events.simulator", "events.simulator.sensor", "imaging", "imaging.edi"}]
LATER_KNOTS = [
    {"body.adapters", "body.smpl"},
    {"capture.capture", "capture.training_capture"},
    {"cli.demo", "cli.main", "cli.train", "cli.viewer_process"},
    {"footage.folder", "footage.footage", "footage.video"},
    {"view.panel", "view.pose_panel", "view.save_panel"},
]
# What sees all of a recording: `Capture` hides nothing of what is held out from training.
SEE_EVERYTHING = set("benching capture evaluation export film synthesis view".split()) | {
    "masks.capture",  # these four open a capture and give `for_training` of it to the rest
    "restore.capture",
    "training.run",
    "training.train",
    "body.track",  # the type alone, for evaluation with dense poses
    ROOT,
}
SEE_TRAINING_ALONE = set("calibration deform gaussians hugs methods objectives".split())


class Import(NamedTuple):
    module: str
    target: str
    name: str
    now: bool  # when the module is imported; not in a function, not for types alone


def _named(path: Path) -> str:
    parts = path.relative_to(SOURCE).with_suffix("").parts
    return ".".join(part for part in parts if part != "__init__") or ROOT


FILES = {_named(path): path for path in (*SOURCE.rglob("*.py"), *SOURCE.rglob("*.pyi"))}
TREES = {module: ast.parse(path.read_text("utf-8")) for module, path in FILES.items()}


def _imports(module: str, node: ast.AST, now: bool = True) -> Iterator[Import]:
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.Import):
            for full, name in ((f"{entry.name}.", "") for entry in child.names):
                if full.startswith(f"{ROOT}."):
                    yield Import(module, full[len(ROOT) + 1 : -1] or ROOT, name, now)
        elif isinstance(child, ast.ImportFrom):
            assert child.level == 0, f"{module}: a relative import"
            package, _, inside = f"{child.module}".partition(".")
            for name in (entry.name for entry in child.names if package == ROOT):
                whole = f"{inside}.{name}".lstrip(".")
                yield Import(module, whole if whole in FILES else inside or ROOT, name, now)
        else:
            function = isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
            types = isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test)
            yield from _imports(module, child, now and not function and not types)


IMPORTS = [found for module, tree in TREES.items() for found in _imports(module, tree)]


def _within(module: str, folders: set[str]) -> str | None:
    """The innermost of ``folders`` that the module is in, or is."""
    parts = module.split(".")
    tried = (".".join(parts[:count]) for count in range(len(parts), 0, -1))
    return next((name for name in tried if name in folders), None)


def _upward() -> set[tuple[str, str]]:
    places = {module: _within(module, set(RANK)) for module in FILES}
    return {
        (found.module, found.target)
        for found in IMPORTS
        if found.target != ROOT and places[found.module] != places[found.target]
        if RANK[places[found.module]] <= RANK[places[found.target]]
    }


def _knots(*, now: bool) -> list[set[str]]:
    runs = {module: set() for module in FILES}
    for found in IMPORTS:
        parts = found.target.split(".")  # importing a.b runs a as well, but where it is running
        packages = {".".join(parts[:count]) for count in range(1, len(parts) + 1)}
        above = {name for name in packages if f"{found.module}.".startswith(f"{name}.")}
        runs[found.module] |= packages - above - {ROOT} if found.now or not now else set()
    reached = {}
    for module in FILES:
        reached[module], waiting = set(), [module]
        while waiting:
            new = runs[waiting.pop()] - reached[module]
            reached[module] |= new
            waiting += new
    knots = ({b for b in reached[a] if a in reached[b]} for a in FILES)
    return sorted({frozenset(knot) for knot in knots if knot}, key=sorted)


def test_every_folder_has_a_layer_and_every_layer_a_folder():
    assert {_within(module, set(RANK)) for module in FILES} == set(RANK)


def test_folders_import_from_lower_layers_alone():
    assert _upward() - EXCEPTIONS == set()


def test_every_exception_is_still_needed():
    assert EXCEPTIONS - _upward() == set()


def test_files_that_import_each_other_are_the_ones_we_know():
    assert _knots(now=True) == KNOTS
    assert _knots(now=False) == sorted(KNOTS + LATER_KNOTS, key=sorted)


def test_the_package_takes_nothing_of_its_own_top_but_the_version():
    taken = {found.name for found in IMPORTS if found.target == ROOT} - {""}
    for node in (node for tree in TREES.values() for node in ast.walk(tree)):
        if isinstance(node, ast.Attribute) and ast.unparse(node.value) == ROOT:
            taken.add(node.attr)
    assert taken == {"__version__"}


def _seers() -> set[str]:
    """Modules that import what sees all of a recording."""
    return {
        found.module
        for found in IMPORTS
        if found.name in ("Capture", "load_capture") or found.target == "capture.capture"
    }


def test_what_training_is_made_of_never_imports_the_whole_capture():
    assert not {module for module in _seers() if _within(module, SEE_TRAINING_ALONE)}


def test_the_whole_capture_is_imported_where_it_is_needed_and_nowhere_else():
    assert {_within(module, SEE_EVERYTHING) or module for module in _seers()} == SEE_EVERYTHING


def test_nobody_reaches_behind_a_training_capture():
    for module, tree in TREES.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.Attribute) and node.attr in ("_source", "_masker"):
                inside = _within(module, {"capture"}) or ast.unparse(node.value) == "self"
                assert inside, f"{module}: {ast.unparse(node)}"
