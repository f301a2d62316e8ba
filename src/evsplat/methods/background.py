"""What a still camera sees behind the person: the median of the frames where they are elsewhere.

Where they never are, what lies around goes on.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from scipy.ndimage import distance_transform_edt
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

from evsplat.body import BodyTrack, track_silhouette
from evsplat.capture import Frame, TrainingCapture

LEAST = 1 / 9
"""Share of the band, but a pixel at least, by which the body must have been away for a place to
count as seen: an outline's own pixels show the person in part."""
MOST_FRAMES = 48
"""Training frames that are looked at, spread evenly: the body's outlines take the time."""
NEVER = -1.0
"""Distance to the body of what a frame does not show."""


def background_without(
    capture: TrainingCapture, track: BodyTrack, band_px_at_256: float
) -> Float[Tensor, "H W 3"]:
    """Per-pixel median of the training frames whose posed body stays ``band_px_at_256`` away.

    Somebody who hardly moves is before a pixel in most of the frames, and would be in a median of
    all. The band, for a picture 256 pixels high, is how far clothes, hair and errors of the poses
    reach beyond the body. Where it is in every frame those count in which the body is farthest.
    What it hides or touches in all of them nobody saw: there the colours around go on evenly, where
    a median would show the person.
    """
    frames = looked_at(capture)
    # In eight bits and row by row: 48 large pictures would fill the memory.
    coded = [(255 * capture.image(frame)).round().byte().cpu().numpy() for frame in frames]
    band = band_px_at_256 * coded[0].shape[0] / 256
    near = [np.minimum(apart(capture, track, frame), band).astype(np.float16) for frame in frames]
    return median_far_away(np.stack(coded), np.stack(near), band)


def looked_at(capture: TrainingCapture) -> tuple[Frame, ...]:
    """The training frames that a background is made of, `MOST_FRAMES` at most."""
    frames = capture.train_frames
    return frames[:: -(-len(frames) // MOST_FRAMES)]


def median_far_away(
    pictures: UInt8[np.ndarray, "F H W 3"], near: Float[np.ndarray, "F H W"], band: float
) -> Float[Tensor, "H W 3"]:
    """Per-pixel median of the frames in which the body is farthest; see `background_without`.

    ``near``: pixels to the body, at most ``band``; `NEVER` where a frame shows nothing.
    """
    farthest = near.max(0)
    counts = near == farthest
    rows = [_median_of(pictures[:, row], counts[:, row]) for row in range(pictures.shape[1])]
    picture = torch.from_numpy(np.stack(rows) / np.float32(255))
    return gone_on(picture, torch.from_numpy(farthest > max(1.0, LEAST * band)))


def gone_on(picture: Float[Tensor, "H W 3"], seen: Bool[Tensor, "H W"]) -> Float[Tensor, "H W 3"]:
    """The picture, and where it was not seen the colours around it, as evenly as they go.

    Means over squares of pixels that were seen, twice as large from level to level until all are
    known, are carried back down and interpolated (pull and push: Gortler et al., The Lumigraph,
    SIGGRAPH 1996, section 3.4). A picture of which nothing was seen stays.
    """
    if not seen.any():
        return picture
    known = seen.to(picture)[None, None]
    return _filled(picture.movedim(-1, 0)[None] * known, known)[0].movedim(0, -1)


def _filled(colours: Float[Tensor, "1 3 H W"], known: Float[Tensor, "1 1 H W"]) -> Tensor:
    """Colours of every pixel from those of which ``known`` is 1; the others are 0."""
    if known.all():
        return colours
    height, width = known.shape[-2:]
    sums, shares = (avg_pool2d(each, 2, ceil_mode=True) for each in (colours, known))
    coarse = _filled(sums / shares.clamp_min(1e-6), (shares > 0).to(shares))
    fine = interpolate(coarse, scale_factor=2, mode="bilinear", align_corners=False)
    return torch.where(known > 0, colours, fine[..., :height, :width])


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


def apart(capture: TrainingCapture, track: BodyTrack, frame: Frame) -> Float[np.ndarray, "H W"]:
    """Pixels to the body as it is at the ends and in the middle of the exposure."""
    times = sorted({*frame.exposure_us, frame.mid_us})
    cameras = capture.cameras_at(frame.camera, times)
    seen = [
        track_silhouette(track, time, camera).numpy()
        for time, camera in zip(times, cameras, strict=True)
    ]
    body = np.logical_or.reduce(seen)
    return distance_transform_edt(~body) if body.any() else np.full(body.shape, np.inf)
