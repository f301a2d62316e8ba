"""The body of a capture and its pose at any time."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from evsplat.body.body import Body
from evsplat.body.make import default_body, make_body
from evsplat.body.smpl import smpl_body
from evsplat.body.track import BodyTrack
from evsplat.capture.body_file import BodyFile
from evsplat.capture.capture import Capture
from evsplat.capture.training_capture import TrainingCapture
from evsplat.errors import DataError


def load_body_track(
    capture: Capture | TrainingCapture,
    *,
    dense: bool = False,
    body_models: Path | None = None,
) -> BodyTrack:
    """The capture's body with its key poses; ``dense`` takes the true poses of body_dense.npz.

    The dense poses are for evaluation and ablation, never for training. ``body_models`` is as of
    `load_body`.

    Raises:
        DataError: no body, no dense poses where they are asked for, or poses of other joints.
    """
    body, order = load_body(capture.body_file, body_models)
    file = capture.body_file
    if dense:
        if capture.dense_body_file is None:
            raise DataError(
                f"{capture.path}: body_dense.npz not found, but dense poses were asked for."
            )
        file = capture.dense_body_file
    poses = np.asarray(file.poses)
    if poses.ndim != 3 or poses.shape[1] != len(order):
        raise DataError(
            f"{file.path}: poses has shape {poses.shape}, expected (P, {len(order)}, 3) "
            f"for the joints of the body."
        )
    errors = file.errors
    if errors is not None:
        errors = replace(errors, joint_rad=errors.joint_rad[:, order])
    return BodyTrack(
        body,
        file.times_us,
        poses if order == list(range(len(order))) else poses[:, order],
        file.transl,
        source=str(file.path),
        errors=errors,
        camera_up=_camera_up(capture),
        up=None if capture.up is None else torch.tensor(capture.up),
    )


def _camera_up(capture: Capture | TrainingCapture) -> Float[Tensor, "3"]:
    """Mean over the frames of the unit vectors in the world that lie upwards in their pictures."""
    upwards = [-capture.camera(frame).world_to_camera[1, :3] for frame in capture.frames]
    return torch.stack(upwards).mean(0).cpu()


def load_body(file: BodyFile, body_models: Path | None = None) -> tuple[Body, list[int]]:
    """The body that a file names, and the order of the file's joints in it.

    ``poses[:, order]`` are the file's poses in the body's joint order. The SMPL family is read
    from the user's licensed files: the one at ``body_models`` or under this folder, by default
    under the folder that EVSPLAT_BODY_MODELS names.
    """
    rig = file.rig
    if rig is not None:
        missing = [name for name, value in rig.items() if value is None]
        if missing:
            raise DataError(
                f"{file.path}: model is 'rig' but {', '.join(missing)} is missing; a rig needs "
                f"all of {', '.join(rig)}."
            )
        return make_body(**rig, source=str(file.path))
    source = f"{file.path}: betas"
    if file.model == "default":
        body = default_body(file.betas, source=source)
    elif file.model in ("smpl", "smplh", "smplx"):
        gender = file.gender or "neutral"
        body = smpl_body(file.model, file.betas, gender=gender, path=body_models, source=source)
    else:
        raise DataError(
            f"{file.path}: model is '{file.model}', expected one of "
            "rig, default, smpl, smplh, smplx."
        )
    return body, list(range(len(body.parents)))
