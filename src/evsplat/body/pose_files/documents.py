"""Opening pose files without running anything that is in them."""

import io
import re
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from evsplat.body.smpl_skeleton import rest_pelvis
from evsplat.errors import DataError
from evsplat.untrusted.arrays import read_npy, read_npz
from evsplat.untrusted.faults import ordinary_file
from evsplat.untrusted.pickles import read_pickle
from evsplat.untrusted.tensors import load_torch
from evsplat.untrusted.text import read_json

_WHAT = "pose file"


@dataclass(frozen=True)
class Document:
    """One file's content as plain containers and numpy arrays."""

    path: Path
    number: int
    """The last number in the file's name, 0 without one: often the frame."""
    content: Any


@dataclass(frozen=True)
class Request:
    """Wishes of the caller of `read_poses`."""

    path: Path
    person: str | int | None = None
    world: bool = False
    image_size: tuple[int, int] | None = None
    rest_pelvis: tuple[float, float, float] | None = None
    body_models: Path | str | None = None

    def pelvis(self, model: str, betas: np.ndarray, source: str) -> np.ndarray:
        """Rest root joint (3,) of the subject, for files that do not turn the body about it."""
        return rest_pelvis(
            model,
            betas.mean(0),
            given=self.rest_pelvis,
            body_models=self.body_models,
            source=source,
        )


def pose_paths(path: Path) -> list[Path]:
    """The file, or a folder's pose files in the order of their numbers."""
    if path.is_file():
        return [path]
    if not path.is_dir():
        raise DataError(f"{path}: file or folder not found.")
    folder = path / "hps" if (path / "hps").is_dir() else path
    found: dict[str, list[Path]] = {}
    for file in folder.iterdir():
        known = file.suffix in _READERS and re.search(r"\d", file.stem)
        if known and file.is_file() and not file.name.startswith("."):
            found.setdefault(file.suffix, []).append(file)
    if not found:
        raise DataError(
            f"{folder}: holds no numbered files of {', '.join(_READERS)}; give the pose file, or "
            "the folder with one file per frame."
        )
    most = max(found.values(), key=lambda files: len(files))
    return sorted(most, key=lambda file: (_number(file), file.name))


def open_document(path: Path) -> Document:
    """The content of one file.

    Raises:
        DataError: missing, damaged, of an unknown kind, or holding pickled types other than arrays,
            tensors and plain containers.
    """
    if path.suffix not in _READERS:
        raise DataError(
            f"{path}: pose files end in {', '.join(_READERS)}; this one in '{path.suffix}'."
        )
    return Document(path, _number(path), _READERS[path.suffix](path))


def _number(path: Path) -> int:
    numbers = re.findall(r"\d+", path.stem)
    return int(numbers[-1][-15:]) if numbers else 0


def _read_torch(path: Path) -> Any:
    ordinary_file(path)
    try:
        return _arrays(load_torch(path))
    except Exception as error:  # torch's readers raise nearly anything on damaged files
        named = re.search(r"GLOBAL (\S+)", str(error))
        if named:
            raise DataError(
                f"{path}: holds the pickled type {named[1]}, which no {_WHAT} needs, so it was not "
                "loaded; get the file again from its official source."
            ) from None
        # torch's own words would advise to load without care.
        raise DataError(
            f"{path}: not a readable {_WHAT} (damaged, or not of torch.save)."
        ) from error


def _arrays(value: Any) -> Any:
    """The same containers with arrays for tensors."""
    if isinstance(value, torch.Tensor):
        return value.detach().to_dense().numpy()
    if isinstance(value, Mapping):
        return {key: _arrays(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_arrays(entry) for entry in value]
    return value


class _Storage:
    """The numbers of a tensor in an ordinary pickle: bytes that torch wrote."""

    def __init__(self, data: bytes) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            try:
                stored = load_torch(io.BytesIO(data))
                self.flat = torch.tensor([], dtype=stored.dtype).set_(stored.untyped())
            except Exception:  # as above
                raise ValueError("a damaged tensor") from None


class _Tensor:
    """A tensor in an ordinary pickle, built as an array."""

    def __new__(cls, storage: _Storage, offset: int, size: Any, stride: Any, *rest: Any) -> Any:
        if np.prod(size, dtype=np.float64) > storage.flat.numel():
            raise ValueError(f"a tensor of {tuple(size)} in {storage.flat.numel()} numbers")
        try:
            return torch.as_strided(storage.flat, size, stride, offset).numpy().copy()
        except RuntimeError:
            raise ValueError("a damaged tensor") from None


class _DefaultDict(dict):
    """A defaultdict without its factory."""

    def __init__(self, factory: Any = None) -> None:
        super().__init__()


def _stand_in(module: str, name: str) -> type | None:
    return {
        ("collections", "defaultdict"): _DefaultDict,
        ("builtins", "dict"): dict,
        ("builtins", "list"): list,
        ("torch._utils", "_rebuild_tensor_v2"): _Tensor,
        ("torch.storage", "_load_from_bytes"): _Storage,
    }.get((module, name))


_READERS: dict[str, Callable[[Path], Any]] = {
    ".pt": _read_torch,
    ".pth": _read_torch,
    ".pkl": lambda path: read_pickle(path, what=_WHAT, stand_ins=_stand_in),
    ".npy": lambda path: read_npy(path, what=_WHAT, stand_ins=_stand_in),
    ".npz": lambda path: read_npz(path, what=_WHAT, stand_ins=_stand_in),
    ".json": read_json,
}
