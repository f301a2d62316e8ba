"""Files of strangers are parsed in `evsplat.untrusted` and nowhere else."""

import ast
import functools

import pytest

from ..source import modules

READERS = {
    *("json.load", "json.loads", "json.JSONDecoder", "tomllib.load", "tomllib.loads"),
    *("yaml.load", "yaml.load_all", "yaml.safe_load", "yaml.safe_load_all", "yaml.parse"),
    *("yaml.compose", "yaml.full_load", "yaml.unsafe_load"),
    *("numpy.load", "numpy.loadtxt", "numpy.genfromtxt", "numpy.fromfile", "numpy.memmap"),
    *("pickle.load", "pickle.loads", "pickle.Unpickler", "pickle._Unpickler", "joblib.load"),
    *("PIL.Image.open", "imageio.imread", "imageio.v2.imread", "imageio.v3.imread"),
    *("cv2.imread", "cv2.imdecode", "cv2.VideoCapture", "cv2.FileStorage", "av.open"),
    *("h5py.File", "zipfile.ZipFile", "tarfile.open"),
    *("torch.load", "safetensors.safe_open", "safetensors.torch.load_file"),
}
# A pipe from the parent process, which wrote it a moment before.
OWN_PIPE = ("benching/local.py", "pickle.load")

# The gate out, files of the package, of the system and of a folder that was made a moment before.
OWN_FILES = {
    *(("disk.py", "open"), ("files.py", "open"), ("cli/exits.py", "open")),
    *(("pages.py", "read_text"), ("export/avatar.py", "read_text"), ("devices.py", "read_text")),
    *(("evaluation/report/clip.py", "read_bytes"), ("view/save_panel.py", "read_bytes")),
    ("benching/local.py", "read_text"),
}
CONTAINERS = ("av", "archive", "found", "Showcase(folder.path)")
"""Have an ``open`` of their own, which opens no file to read it."""


@functools.cache
def calls(tree: ast.Module) -> list[tuple[str, ast.Call]]:
    """Full names of what is called, and the calls."""
    names, found = {}, []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for entry in node.names:
                whole = entry.name if entry.asname else entry.name.split(".")[0]
                names[entry.asname or whole] = whole
        elif isinstance(node, ast.ImportFrom):
            names |= {
                entry.asname or entry.name: f"{node.module}.{entry.name}" for entry in node.names
            }
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            first, _, rest = ast.unparse(node.func).partition(".")
            found.append((f"{names.get(first, first)}.{rest}".rstrip("."), node))
    return found


def writes(call: ast.Call) -> bool:
    """Whether a call opens a file to write it, which no stranger's bytes are needed for."""
    modes = [*call.args[:2], *(word.value for word in call.keywords if word.arg == "mode")]
    return any(isinstance(mode, ast.Constant) and mode.value in ("w", "x") for mode in modes)


def openings(tree: ast.Module) -> set[str]:
    """Ways in which a module opens files to read them, other than those of the gate."""
    found = set()
    for name, call in calls(tree):
        way = name.rpartition(".")[2]
        archive = (
            isinstance(call.func, ast.Attribute) and ast.unparse(call.func.value) in CONTAINERS
        )
        if way in ("open", "read_text", "read_bytes") and not archive and not writes(call):
            # read_text(path) is the gate's own, path.read_text() is not
            if way == "open" or isinstance(call.func, ast.Attribute):
                found.add(way)
    return found


def found_in(tree: ast.Module) -> list[str]:
    return [name for name, call in calls(tree) if name in READERS and not writes(call)]


def others() -> dict[str, ast.Module]:
    """The modules that are not the gate."""
    return {path: tree for path, tree in modules().items() if not path.startswith("untrusted/")}


def test_no_other_module_calls_a_parser_of_files():
    found = {(path, name) for path, tree in others().items() for name in found_in(tree)}
    assert found == {OWN_PIPE}


def test_no_other_module_opens_a_file_that_may_be_a_pipe():
    found = {(path, way) for path, tree in others().items() for way in openings(tree)}
    assert found == OWN_FILES
    read, written = (
        "path.open('rb')\nopen(path)\npath.read_bytes()",
        "path.open('w')\nread_text(path)",
    )
    assert openings(ast.parse(read)) == {"open", "read_bytes"}
    assert openings(ast.parse(written)) == set()


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("import numpy as np\nnp.load(path)", "numpy.load"),
        ("from PIL import Image\nwith Image.open(path) as image: pass", "PIL.Image.open"),
        ("def f():\n    from json import loads as parse\n    parse(text)", "json.loads"),
        ("import h5py\nh5py.File(path, 'r')", "h5py.File"),
        ("import imageio.v3\nimageio.v3.imread(path)", "imageio.v3.imread"),
    ],
)
def test_calls_are_known_by_whatever_name(text: str, name: str):
    assert found_in(ast.parse(text)) == [name]
    assert found_in(ast.parse("import h5py\nh5py.File(path, 'w')")) == []
