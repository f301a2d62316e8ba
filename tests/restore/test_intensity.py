"""Brightness from events, colour from the blurry frame."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from evsplat.capture import load_capture
from evsplat.errors import DataError
from evsplat.restore.intensity import FromEvents, with_brightness

from ..seen import seen

LUMA = torch.tensor([0.2126, 0.7152, 0.0722])


def _scene(seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand((1, 3, 8, 10), generator=generator)
    size = (64, 80)
    smooth = torch.nn.functional.interpolate(coarse, size, mode="bicubic", align_corners=False)
    return (0.2 + 0.6 * smooth.clamp(0, 1))[0].permute(1, 2, 0).contiguous()


@pytest.mark.parametrize("seed", range(4))
def test_the_true_brightness_in_any_unit_changes_nothing(seed: int) -> None:
    """A network that is right up to brightness and contrast gives the picture back."""
    picture = _scene(seed)
    rng = np.random.default_rng(seed)
    for gain in rng.uniform(0.5, 3, 3):
        intensity = float(gain) * (picture @ LUMA) + rng.normal()
        restored = with_brightness(picture, intensity, torch.ones(64, 80))
        assert (restored - picture).abs().max() < 2e-3


@pytest.mark.parametrize("seed", range(4))
def test_only_brightness_changes_and_only_where_something_moved(seed: int) -> None:
    picture, other = _scene(seed), _scene(seed + 100) @ LUMA
    moved = torch.zeros(64, 80)
    moved[20:40, 30:50] = 1
    restored = with_brightness(picture, other, moved)
    away = torch.ones(64, 80, dtype=torch.bool)
    away[18:42, 28:52] = False
    assert torch.equal(restored[away], picture[away])
    inside = restored[22:38, 32:48]
    assert (inside - picture[22:38, 32:48]).abs().max() > 0.03
    # one factor for all channels of a pixel, unless it left the range
    ratio = (inside / picture[22:38, 32:48])[(inside < 1).all(-1)]
    assert (ratio.amax(-1) - ratio.amin(-1)).abs().max() < 1e-4


def test_an_edge_that_blur_smeared_comes_back() -> None:
    sharp = torch.full((64, 64, 3), 0.3)
    sharp[:, 32:] = 0.7
    blurry = sharp.clone()
    blurry[:, 26:38] = torch.linspace(0.3, 0.7, 12)[None, :, None]
    moved = torch.zeros(64, 64)
    moved[:, 25:39] = 1
    restored = with_brightness(blurry, (sharp @ LUMA) ** 2, moved, over=0.1)
    error = ((restored - sharp) ** 2).mean(), ((blurry - sharp) ** 2).mean()
    assert error[0] < 0.15 * error[1]


def test_a_flat_picture_and_no_events_are_no_trouble() -> None:
    picture, flat = _scene(0), torch.zeros(64, 80)
    assert torch.equal(with_brightness(picture, flat, torch.zeros(64, 80)), picture)
    assert torch.isfinite(with_brightness(picture, flat, torch.ones(64, 80))).all()


class _Counting(FromEvents):
    """Says how many events of each polarity every window had."""

    name = "net"

    def __init__(self, capture) -> None:
        super().__init__(capture)
        self.windows: list[tuple[int, int, int]] = []
        self.resets = 0

    def find(self, weights):
        return Path(__file__)

    def load(self, path):
        return torch.nn.Identity()

    def reset(self) -> None:
        self.resets += 1

    def step(self, events, height, width):
        assert (height, width) == (48, 64)
        self.windows.append((int(events.t[0]), int(events.t[-1]), len(events)))
        return torch.zeros(height, width)


def test_windows_follow_each_other_from_mid_exposure_to_mid_exposure(tiny_capture) -> None:
    capture = seen(tiny_capture(width=64, height=48), use="everything")
    network = _Counting(capture)
    frames = [frame for frame, _ in network.restore(capture, capture.frames)]
    mids = [frame.mid_us for frame in capture.frames]
    assert [frame.mid_us for frame in frames] == mids
    for (first, last, count), start, end in zip(
        network.windows, [2 * mids[0] - mids[1], *mids], mids, strict=False
    ):
        assert start <= first <= last < end
        assert count == len(capture.events.between(start, end))
    assert network.provenance()["weights"] == Path(__file__).name and network.resets == 1


def test_the_network_begins_anew_behind_a_held_out_interval(tiny_capture) -> None:
    capture = seen(tiny_capture(frames=20, width=64, height=48))
    network = _Counting(capture)
    asked = capture.train_frames[4:9]
    frames = [frame for frame, _ in network.restore(capture, asked)]
    assert frames == list(asked) and network.resets == 2
    mids = [frame.mid_us for frame in capture.train_frames]
    # frame 10 follows three that are held out: its window begins where training goes on
    begins = [2 * mids[0] - mids[1], *mids[:6], capture.train_frames[7].exposure_us[0], *mids[7:]]
    assert len(network.windows) == len(mids)
    for (first, last, count), start, end in zip(network.windows, begins, mids, strict=False):
        assert start <= first <= last < end
        assert count == len(capture.events.between(start, end))


def test_what_it_cannot_work_with_is_said(tiny_capture) -> None:
    path = tiny_capture()
    document = json.loads((path / "capture.json").read_text())
    (path / "capture.json").write_text(json.dumps({**document, "events": None}))
    with pytest.raises(DataError, match="no events, which net"):
        _Counting(load_capture(path))
