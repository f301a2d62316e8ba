"""Reading a user's licensed SMPL-family files without running code that they might hold.

The files are Python pickles, or npz archives with pickled members. body-models 0.26 reads both
without restriction (`pickle.Unpickler.find_class` of the parent class for every unknown name,
`allow_pickle=True` for npz), so a tampered file could run anything. Here only the few types that
these files need are allowed (`evsplat.safe_pickle`); every other name in a file is an error.
"""

from pathlib import Path
from typing import Any

import numpy as np

from evsplat.errors import DataError
from evsplat.safe_pickle import read_npz, read_pickle

_KEYS = ("v_template", "f", "weights", "shapedirs", "posedirs", "J_regressor", "kintree_table") + (
    "hands_meanl",
    "hands_meanr",
    "joint2num",
)
_SPARSE = ("scipy.sparse.csc", "scipy.sparse._csc")


def read_model_file(path: Path) -> dict[str, Any]:
    """The arrays of an SMPL-family .pkl or .npz, and joint names by index where they are given.

    Raises:
        DataError: unreadable, or holding a pickled type that no body model needs.
    """
    what = "body model"
    if path.suffix == ".npz":
        raw = read_npz(path, what=what, keys=_KEYS, stand_ins=_stand_in)
    else:
        raw = read_pickle(path, what=what, stand_ins=_stand_in)
    if not isinstance(raw, dict):
        raise DataError(
            f"{path}: not a readable body model (holds a {type(raw).__name__}, expected a dict)."
        )
    try:
        return {key: _plain(raw[key]) for key in _KEYS if key in raw}
    except (ValueError, TypeError, AttributeError) as error:
        raise DataError(f"{path}: not a readable body model ({error}).") from error


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


def _stand_in(module: str, name: str) -> type | None:
    if module == "chumpy" or module.startswith("chumpy."):
        return _Chumpy
    return _SparseColumns if module in _SPARSE and name == "csc_matrix" else None


def _plain(value: Any) -> Any:
    if isinstance(value, _Chumpy | _SparseColumns):
        return value.value
    if isinstance(value, np.ndarray) and value.dtype.hasobject:
        return _plain(value.item())  # 0-d: a dict, or an object that was wrapped on saving
    if isinstance(value, dict):
        return {str(name): int(index) for name, index in value.items()}
    return np.asarray(value)
