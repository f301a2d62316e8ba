"""Characters and motions that ship, and the user's own files in their place."""

from importlib.resources import files
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from evsplat.errors import DataError
from evsplat.untrusted.pictures import read_picture


def characters() -> tuple[str, ...]:
    """Names of the characters that ship."""
    return _names("characters", ".npz")


def motions() -> tuple[str, ...]:
    """Names of the motions that ship."""
    return _names("motions", ".txt")


def find_character(name: str) -> Path:
    """The file of a shipped character, or ``name`` as a path."""
    return _find("character", name, characters(), _folder() / "characters" / f"{name}.npz")


def find_motion(name: str) -> Path:
    """The file of a shipped motion, or ``name`` as a path."""
    return _find("motion", name, motions(), _folder() / "motions" / f"{name}.txt")


def _folder() -> Path:
    return Path(str(files("evsplat") / "data" / "stage"))


def _names(kind: str, suffix: str) -> tuple[str, ...]:
    return tuple(sorted(path.stem for path in (_folder() / kind).glob(f"*{suffix}")))


def _find(kind: str, name: str, known: tuple[str, ...], shipped: Path) -> Path:
    if name in known:
        return shipped
    if Path(name).is_file():
        return Path(name)
    raise DataError(
        f"{kind} {name!r}: neither a file nor one of {', '.join(known)}; correct the name or path."
    )


def read_rgba(path: Path) -> UInt8[np.ndarray, "H W 4"]:
    """A picture with its transparency (opaque where it has none)."""
    return read_picture(path, lambda image: np.array(image.convert("RGBA")))
