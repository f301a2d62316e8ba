"""The package's modules as they are written, for tests of what may stand in them."""

import ast
import functools
from pathlib import Path

SOURCE = Path(__file__).parents[1] / "src" / "evsplat"


@functools.cache
def modules() -> dict[str, ast.Module]:
    """Syntax tree of each module by its path in the package; nobody changes them."""
    paths = sorted(SOURCE.rglob("*.py"))
    return {
        path.relative_to(SOURCE).as_posix(): ast.parse(path.read_text("utf-8")) for path in paths
    }
