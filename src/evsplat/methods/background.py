"""What a still camera sees behind the person: the median of the frames where they are elsewhere."""

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from evsplat.body import BodyTrack, silhouette
from evsplat.capture import Frame, TrainingCapture

LEAST = 0.5
"""Share of the band that the body must be away at some time for frames to be chosen by that."""
MOST_FRAMES = 48
"""Training frames that are looked at, spread evenly: the body's outlines take the time."""


def background_without(
    capture: TrainingCapture, track: BodyTrack, band_px_at_256: float
) -> Float[Tensor, "H W 3"]:
    """Per-pixel median of the training frames whose posed body stays ``band_px_at_256`` away.

    Somebody who hardly moves is before a pixel in most of the frames, and would be in a median of
    all. The band, for a picture 256 pixels high, is how far clothes, hair and errors of the poses
    reach beyond the body. Where it is in every frame those count in which the body is farthest, and
    all of them where it is hardly away in any.
    """
    frames = capture.train_frames
    frames = frames[:: -(-len(frames) // MOST_FRAMES)]
    # In eight bits and row by row: 48 large pictures would fill the memory.
    coded = [(255 * capture.image(frame)).round().byte().cpu().numpy() for frame in frames]
    band = band_px_at_256 * coded[0].shape[0] / 256
    near = [np.minimum(_apart(capture, track, frame), band).astype(np.float16) for frame in frames]
    pictures, apart = np.stack(coded), np.stack(near)
    farthest = apart.max(0)
    counts = (apart == farthest) | (farthest < LEAST * band)
    rows = [_median_of(pictures[:, row], counts[:, row]) for row in range(pictures.shape[1])]
    return torch.from_numpy(np.stack(rows) / np.float32(255))


def _median_of(
    stack: UInt8[np.ndarray, "F W 3"], counts: Bool[np.ndarray, "F W"]
) -> Float[np.ndarray, "W 3"]:
    """Median over the frames that count at a pixel, one at least."""
    ordered = np.sort(np.where(counts[..., None], stack.astype(np.float32), np.inf), axis=0)
    number = counts.sum(0)[None, :, None]
    low, high = (
        np.take_along_axis(ordered, index, 0)[0] for index in ((number - 1) // 2, number // 2)
    )
    middle: Float[np.ndarray, "W 3"] = 0.5 * (low + high)
    return middle


def _apart(capture: TrainingCapture, track: BodyTrack, frame: Frame) -> Float[np.ndarray, "H W"]:
    """Pixels to the body as it is at the ends and in the middle of the exposure."""
    camera = capture.camera(frame)
    times = sorted({*frame.exposure_us, frame.mid_us})
    seen = [silhouette(track.vertices(time), track.body.faces, camera).numpy() for time in times]
    body = np.logical_or.reduce(seen)
    return distance_transform_edt(~body) if body.any() else np.full(body.shape, np.inf)
