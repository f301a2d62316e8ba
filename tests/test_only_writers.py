"""`files` and `disk` alone open, make, move and remove; encoders write where these two say."""

import ast
from collections.abc import Iterator

import pytest

from .source import modules

WRITERS = {"files.py", "disk.py"}
METHODS = {"write_text", "write_bytes", "mkdir", "touch", "unlink", "rmdir", "symlink_to"}
METHODS |= {"hardlink_to"}
CALLS = {
    "shutil": {"rmtree", "move", "copy", "copy2", "copyfile", "copytree"},
    "os": {"open", "replace", "rename", "remove", "unlink", "mkdir", "makedirs", "link", "symlink"},
    "tempfile": {"mkstemp", "mkdtemp", "TemporaryFile", "NamedTemporaryFile", "TemporaryDirectory"},
}
CALLS["os"] |= {"rmdir", "removedirs", "truncate", "mkfifo", "mknod"}
# Libraries that write a format: into a path that `atomic_path` or `new_folder` gave, or to memory.
ENCODERS = {"save", "savez", "savez_compressed", "save_file", "File", "ZipFile"}
ENCODING = {
    "capture/body_file.py": {"savez_compressed"},
    "events/write.py": {"File", "ZipFile", "open"},
    "film/frame_cache.py": {"save"},
    "inspection/drawing.py": {"save"},
    "pages.py": {"save"},
    "pictures/files.py": {"save"},
    "pictures/video.py": {"save", "open"},
    "view/save_panel.py": {"save"},
}
ALLOWED = {("cli/exits.py", "os.open")}  # the device to which nobody listens


def writes(tree: ast.AST) -> Iterator[str]:
    """Calls in a module that may write, by name."""
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call):
            continue
        function = node.func
        name = function.id if isinstance(function, ast.Name) else getattr(function, "attr", "")
        owner = getattr(getattr(function, "value", None), "id", "")
        mode, owner_of_method = _mode(node), isinstance(function, ast.Attribute)
        if name in CALLS.get(owner, ()):
            yield f"{owner}.{name}"
        elif (owner_of_method and name in METHODS) or (name == "open" and set(mode) & set("wax+")):
            yield name
        elif name in ("File", "ZipFile") and not set(mode) & set("wax+"):
            continue
        elif name in ENCODERS and (owner_of_method or name == "save_file"):
            yield name


def _mode(call: ast.Call) -> str:
    words = [*call.args, *(key.value for key in call.keywords if key.arg == "mode")]
    texts = [word.value for word in words if isinstance(word, ast.Constant)]
    return next((text for text in texts if isinstance(text, str) and len(text) < 4), "")


@pytest.mark.parametrize(
    "code",
    [
        "path.open('w')",
        "open(path, mode='ab')",
        "path.write_text('')",
        "shutil.rmtree(path)",
        "np.savez(path)",
        "h5py.File(path, 'w')",
        "os.replace(a, b)",
        "tempfile.mkdtemp()",
    ],
)
def test_writing_is_recognised(code: str) -> None:
    assert len(list(writes(ast.parse(code)))) == 1


def test_reading_is_let_through() -> None:
    for code in ("path.open()", "open(p, 'rb')", "h5py.File(p, 'r')", "zipfile.ZipFile(p, 'r')"):
        assert list(writes(ast.parse(code))) == []


def test_no_other_module_writes() -> None:
    found = set()
    for name, tree in modules().items():
        if name not in WRITERS:
            found |= {(name, call) for call in writes(tree) if call not in ENCODING.get(name, ())}
    assert found - ALLOWED == set()
