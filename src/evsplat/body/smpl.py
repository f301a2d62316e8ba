"""SMPL, SMPL-H and SMPL-X from the user's own licensed files, through the body-models package."""

import os
import pickle
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from evsplat.body.body import Body
from evsplat.body.make import fit_betas, make_body
from evsplat.errors import DataError, WeightsError
from evsplat.files import open_output, scratch_folder
from evsplat.untrusted.arrays import read_npz
from evsplat.untrusted.pickles import read_pickle

ENVIRONMENT = "EVSPLAT_BODY_MODELS"
_SITES = {
    "smpl": "https://smpl.is.tue.mpg.de",
    "smplh": "https://mano.is.tue.mpg.de",
    "smplx": "https://smpl-x.is.tue.mpg.de",
}
_LEGACY = {"neutral": "neutral", "male": "m", "female": "f"}
"""Genders in the file names of SMPL 1.0 and 1.1, such as basicModel_m_lbs_10_207_0_v1.0.0.pkl."""
_KEYS = (
    *("v_template", "f", "weights", "shapedirs", "posedirs", "J_regressor", "kintree_table"),
    *("hands_meanl", "hands_meanr", "joint2num"),
)
_SPARSE = ("scipy.sparse.csc", "scipy.sparse._csc")


def smpl_body(
    family: str,
    betas: Float[np.ndarray, "B"] | None = None,
    *,
    gender: str = "neutral",
    path: Path | str | None = None,
    source: str = "betas",
) -> Body:
    """A subject's shaped body of the SMPL family, without pose blend shapes (as 3DGS-Avatar).

    ``family`` is smpl, smplh or smplx. ``path`` is the model's file or the folder to search, by
    default the folder that the environment variable EVSPLAT_BODY_MODELS names. Hands are flat at
    zero pose, the face is neutral.

    Raises:
        WeightsError: the optional package, the folder or the file is missing.
        DataError: the file is not such a model, or there are too many shape coefficients.
    """
    file = find_model_file(family, gender, path)
    model = _open(family, file)
    shape = fit_betas(betas, model.NUM_SHAPE_COEFFS, source)
    coefficients = [torch.from_numpy(shape).float()[None]]
    if family == "smplx":
        coefficients.append(torch.zeros(1, model.NUM_EXPR_COEFFS))
    identity = model.prepare_identity(*coefficients)
    body, _ = make_body(
        identity["rest_vertices"][0].numpy(),
        np.asarray(model.faces),
        np.asarray(model.skin_weights),
        np.asarray(model.parents),
        identity["rest_joints"][0].numpy(),
        tuple(model.joint_names),
        source=str(file),
    )
    return body


def find_model_file(family: str, gender: str, path: Path | str | None = None) -> Path:
    """The model's file at ``path`` or under the folder that it or the environment names."""
    if gender not in _LEGACY:
        raise DataError(f"gender is '{gender}', expected neutral, male or female.")
    place = path if path is not None else os.environ.get(ENVIRONMENT)
    upper = gender.upper()
    stems = {
        "smpl": [f"SMPL_{upper}", f"basicModel_{_LEGACY[gender]}_lbs_10_207_0_v1.0.0"]
        + [f"basicmodel_{_LEGACY[gender]}_lbs_10_207_0_v1.{minor}.0" for minor in (1, 0)],
        "smplh": [f"SMPLH_{upper}", f"{gender}/model"],
        "smplx": [f"SMPLX_{upper}"],
    }[family]
    wanted = f"{family.upper()} ({gender}): download it from {_SITES[family]} (licence needed)"
    if not place:
        raise WeightsError(
            f"No folder for body models is set for {wanted}, put it at "
            f"<folder>/{family}/{stems[0]}.npz or .pkl and set {ENVIRONMENT}=<folder>."
        )
    place = Path(place)
    if place.is_file():
        return place
    candidates = [
        folder / f"{stem}{suffix}"
        for folder in (place / family, place)
        for stem in stems
        for suffix in (".npz", ".pkl")
    ]
    for candidate in candidates:
        if candidate.is_file():
            return candidate
    raise WeightsError(
        f"{place}: holds no file of {wanted} and put it at {candidates[0]} (or .pkl)."
    )


def read_model_file(path: Path) -> dict[str, Any]:
    """The arrays of an SMPL-family .pkl or .npz, and joint names by index where they are given.

    body-models 0.26 would unpickle without restriction, so that a tampered file could run anything.
    Here only the few types that these files need are allowed (`evsplat.untrusted.pickles`).

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


def _open(family: str, file: Path) -> Any:
    """The body-models object of a file, given to it as a clean copy of the file's arrays.

    The pickle that body-models reads was written by ourselves a moment before, from arrays that
    `read_model_file` let through.
    """
    try:
        module = import_module(f"body_models.{family}.torch")
    except ModuleNotFoundError as error:
        raise WeightsError(
            f"The {family.upper()} body needs the package '{error.name}', which is not installed: "
            "pip install 'evsplat[body-models]'."
        ) from None
    arrays = read_model_file(file)
    missing = [key for key in ("v_template", "shapedirs", "J_regressor") if key not in arrays]
    if missing:
        raise DataError(f"{file}: not a {family.upper()} model, {', '.join(missing)} is missing.")
    with scratch_folder() as folder:
        copy = folder / "model.pkl"
        with open_output(copy) as stream:
            pickle.dump(arrays, stream, protocol=pickle.HIGHEST_PROTOCOL)
        try:
            return getattr(module, family.upper())(model_path=copy)
        except (KeyError, ValueError, TypeError, IndexError) as error:
            raise DataError(f"{file}: not a {family.upper()} model ({error}).") from error


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
