"""Files of strangers are parsed in `evsplat.untrusted` and nowhere else."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

SOURCE = Path(__file__).parents[2] / "src" / "evsplat"
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


def calls(tree: ast.Module) -> Iterator[tuple[str, ast.Call]]:
    """Full names of what is called, and the calls."""
    names = {}
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
            yield f"{names.get(first, first)}.{rest}".rstrip("."), node


def writes(call: ast.Call) -> bool:
    """Whether a call opens a file to write it, which no stranger's bytes are needed for."""
    modes = [*call.args[1:2], *(word.value for word in call.keywords if word.arg == "mode")]
    return any(isinstance(mode, ast.Constant) and mode.value in ("w", "x") for mode in modes)


def found_in(text: str) -> list[str]:
    return [name for name, call in calls(ast.parse(text)) if name in READERS and not writes(call)]


def test_no_other_module_calls_a_parser_of_files():
    found = {
        (path.relative_to(SOURCE).as_posix(), name)
        for path in SOURCE.rglob("*.py")
        if path.parent.name != "untrusted"
        for name in found_in(path.read_text("utf-8"))
    }
    assert found == {OWN_PIPE}


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
    assert found_in(text) == [name]
    assert found_in("import h5py\nh5py.File(path, 'w')") == []
