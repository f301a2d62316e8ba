"""Reading a user's licensed SMPL-family files without running code that they might hold.

The files are Python pickles, or npz archives with pickled members. body-models 0.26 reads both
without restriction (`pickle.Unpickler.find_class` of the parent class for every unknown name,
`allow_pickle=True` for npz), so a tampered file could run anything. Here only the few types that
these files need are allowed; every other name in a file is an error.
"""

import pickle
import warnings
import zipfile
from pathlib import Path
from typing import IO, Any

import numpy as np

from evsplat.errors import DataError

_KEYS = ("v_template", "f", "weights", "shapedirs", "posedirs", "J_regressor", "kintree_table") + (
    "hands_meanl",
    "hands_meanr",
    "joint2num",
)
_NUMPY = ("numpy", "numpy._core.multiarray")
_ALLOWED = (
    {(module, name) for module in _NUMPY for name in ("_reconstruct", "scalar", "ndarray", "dtype")}
    | {("_codecs", "encode")}
    | {(module, "_reconstructor") for module in ("copyreg", "copy_reg")}
    | {(module, "object") for module in ("builtins", "__builtin__")}
)
_SPARSE = ("scipy.sparse.csc", "scipy.sparse._csc")


def read_model_file(path: Path) -> dict[str, Any]:
    """The arrays of an SMPL-family .pkl or .npz, and joint names by index where they are given.

    Raises:
        DataError: unreadable, or holding a pickled type that no body model needs.
    """
    try:
        with warnings.catch_warnings():
            # Files of Python 2 spell a flag of dtype() in a way that numpy 2 warns about.
            warnings.simplefilter("ignore", np.exceptions.VisibleDeprecationWarning)
            raw = _read_npz(path) if path.suffix == ".npz" else _read_pickle(path)
        return {key: _plain(raw[key]) for key in _KEYS if key in raw}
    except _ForbiddenType as error:
        raise DataError(
            f"{path}: holds the pickled type {error}, which no body model needs, so it was not "
            "loaded; download the model again from its official site."
        ) from None
    except (
        OSError,
        EOFError,
        ValueError,
        TypeError,
        KeyError,
        AttributeError,
        IndexError,
    ) as error:
        raise DataError(f"{path}: not a readable body model ({error}).") from error
    except (pickle.UnpicklingError, zipfile.BadZipFile) as error:
        raise DataError(f"{path}: not a readable body model ({error}).") from error


class _ForbiddenType(Exception):
    """A name in a pickle that is not on the list."""


class _Chumpy:
    """Stands for any chumpy object: SMPL's first files wrap some arrays in them."""

    def __setstate__(self, state: dict[str, Any]) -> None:
        if "x" in state:
            self.value = np.asarray(state["x"])
        else:  # a selection of another array
            source = state["a"].value if isinstance(state["a"], _Chumpy) else state["a"]
            chosen = np.asarray(source).reshape(-1)[np.asarray(state["idxs"], np.int64)]
            self.value = chosen.reshape(state.get("preferred_shape", chosen.shape))


class _SparseColumns:
    """A pickled scipy.sparse.csc_matrix, which is no more than its four arrays."""

    def __setstate__(self, state: dict[str, Any]) -> None:
        rows, columns = state["_shape"] if "_shape" in state else state["shape"]
        indices, starts = np.asarray(state["indices"]), np.asarray(state["indptr"])
        self.value = np.zeros((rows, columns))
        np.add.at(
            self.value,
            (indices, np.repeat(np.arange(columns), np.diff(starts))),
            np.asarray(state["data"]),
        )


class _RestrictedUnpickler(pickle.Unpickler):
    """Unpickles numpy arrays, chumpy wrappers and sparse matrices, nothing else."""

    def find_class(self, module: str, name: str) -> Any:
        if module == "chumpy" or module.startswith("chumpy."):
            return _Chumpy
        if module in _SPARSE and name == "csc_matrix":
            return _SparseColumns
        if module == "numpy.core.multiarray":  # before numpy 2
            module = "numpy._core.multiarray"
        if (module, name) in _ALLOWED:
            return super().find_class(module, name)
        raise _ForbiddenType(f"{module}.{name}")


def _read_pickle(path: Path) -> dict[str, Any]:
    with path.open("rb") as stream:
        raw = _RestrictedUnpickler(stream, encoding="latin1").load()
    if not isinstance(raw, dict):
        raise ValueError(f"holds a {type(raw).__name__}, expected a dict")
    return raw


def _read_npz(path: Path) -> dict[str, Any]:
    with zipfile.ZipFile(path) as archive:
        members = {name.removesuffix(".npy") for name in archive.namelist()}
        return {key: _read_member(archive, key) for key in _KEYS if key in members}


def _read_member(archive: zipfile.ZipFile, key: str) -> Any:
    """One array of an npz; an object member is a pickle after the .npy header."""
    with archive.open(f"{key}.npy") as stream:
        if _dtype(stream).hasobject:
            return _RestrictedUnpickler(stream, encoding="latin1").load()
    with archive.open(f"{key}.npy") as stream:
        return np.lib.format.read_array(stream, allow_pickle=False)


def _dtype(stream: IO[bytes]) -> np.dtype:
    """The type of a .npy, leaving the stream after its header."""
    version = np.lib.format.read_magic(stream)
    if version == (1, 0):
        return np.lib.format.read_array_header_1_0(stream)[2]
    if version == (2, 0):
        return np.lib.format.read_array_header_2_0(stream)[2]
    raise ValueError(f"npy format {version}")


def _plain(value: Any) -> Any:
    if isinstance(value, _Chumpy | _SparseColumns):
        return value.value
    if isinstance(value, np.ndarray) and value.dtype.hasobject:
        return _plain(value.item())  # 0-d: a dict, or an object that was wrapped on saving
    if isinstance(value, dict):
        return {str(name): int(index) for name, index in value.items()}
    return np.asarray(value)
