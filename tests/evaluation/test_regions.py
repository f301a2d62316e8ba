"""Where the person is in pictures: by masks, else by the posed body, and where nobody is."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import torch

from evsplat.capture import load_body_track, load_capture
from evsplat.evaluation.regions import Absent, HumanRegions
from evsplat.pictures.box import Box


def masked(capture, mask: torch.Tensor) -> HumanRegions:
    """Regions of a capture whose masks are all this one."""
    return HumanRegions(SimpleNamespace(mask=lambda frame: mask, camera=capture.camera))


def test_a_mask_gives_its_pixels_and_their_box_and_an_empty_one_nobody(tiny_capture):
    capture = load_capture(tiny_capture())
    frame = capture.frames[0]
    camera = capture.camera(frame)
    mask = torch.zeros(camera.height, camera.width)
    mask[4:18, 3:28] = 0.4
    mask[6:16, 5:25] = 0.6
    regions = masked(capture, mask)
    pixels, box = regions.in_frame(frame)
    assert torch.equal(pixels, mask > 0.5) and box == Box(6, 16, 5, 25)
    # A tenth of its height and width on each side.
    assert regions.crop(frame) == Box(5, 17, 3, 27)
    pixels, box = masked(capture, 0.5 * mask).in_frame(frame)
    assert not pixels.any() and isinstance(box, Absent) and "empty" in box.reason
    assert masked(capture, 0.5 * mask).crop(frame) is None


def test_without_a_mask_it_is_where_the_posed_body_is_seen(tiny_capture):
    capture = load_capture(tiny_capture())
    frame = capture.frames[0]
    camera, regions = capture.camera(frame), HumanRegions(capture)
    box = regions.in_view(camera, frame.mid_us)
    pixels = camera.project(load_body_track(capture).vertices(frame.mid_us))[0].numpy()
    low, high = np.floor(pixels.min(0)), np.ceil(pixels.max(0))
    size = camera.width, camera.height
    assert (box.left, box.top) == tuple(np.clip(low, 0, size))
    assert (box.right, box.bottom) == tuple(np.clip(high, 0, size))
    back = torch.diag(torch.tensor([-1.0, 1, -1, 1])) @ camera.world_to_camera
    away = regions.in_view(replace(camera, world_to_camera=back), frame.mid_us)
    assert isinstance(away, Absent) and "out of view" in away.reason
