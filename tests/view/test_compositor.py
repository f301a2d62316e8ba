"""What lies over and beside a drawn picture in the viewer, and where."""

import json

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("viser", reason="needs the extra view: pip install 'evsplat[view]'")

from evsplat.capture import Capture, load_capture  # noqa: E402
from evsplat.events.maps import count_map  # noqa: E402
from evsplat.view import compositor  # noqa: E402
from evsplat.view.camera import BrowserCamera  # noqa: E402
from evsplat.view.compositor import INSET_SHARE, Compositor  # noqa: E402
from evsplat.view.request import BLURRY, SHARP, Motion, ViewRequest  # noqa: E402

BROWSER = BrowserCamera((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.8)
WINDOW_US = 20_000
LABEL = 30
"""Rows that names may cover."""


@pytest.fixture(name="capture")
def _capture(tiny_capture, rng) -> Capture:
    return load_capture(tiny_capture(seed=int(rng.integers(1_000_000))))


class _Painted:
    """A run whose pictures have one grey everywhere."""

    def __init__(self, capture: Capture, grey: float) -> None:
        self.capture, self.name, self.grey = capture, "painted", grey

    def picture(self, camera, time_us, motion, look, *, draft, elsewhere):
        return np.full((camera.height, camera.width, 3), self.grey, np.float32)


def _composed(capture: Capture, request: ViewRequest, **others: float) -> np.ndarray:
    runs = {name: _Painted(capture, grey) for name, grey in others.items()}
    compositor = Compositor(_Painted(capture, 0.5), runs)
    size = request.width, request.height
    return compositor.compose(request, size, draft=False).astype(float) / 255


def _nearest(capture: Capture, time_us: int):
    return min(capture.frames, key=lambda frame: abs(frame.mid_us - time_us))


def _signed(capture: Capture, time_us: int) -> np.ndarray:
    stream = capture.events.between(time_us - WINDOW_US // 2, time_us + WINDOW_US // 2)
    return count_map(stream, capture.events.height, capture.events.width).numpy()


def test_somebody_who_looks_from_elsewhere_sees_the_recording_in_the_corner(capture) -> None:
    """Lower left, framed, as large as said; the nearest frame, with the events of the window."""
    time_us = capture.frames[4].mid_us + 3_000
    request = ViewRequest(300, 200, BROWSER, time_us, events_us=WINDOW_US)
    shown = _composed(capture, request)
    height, margin = INSET_SHARE * 200, 4
    width = height * 32 / 24
    corner = shown[round(200 - margin - height) : 200 - margin, margin : margin + round(width)]
    own = capture.shown(capture.image(_nearest(capture, time_us))).numpy()
    counts = _signed(capture, time_us)
    share = np.sqrt(np.minimum(np.abs(counts) / 3, 1))[..., None]
    colour = np.where(counts[..., None] > 0, (235, 40, 40), (40, 90, 245)) / 255
    expected = _resized(own * (1 - share) + colour * share, corner.shape[:2])
    assert np.abs(counts).max() > 0 and corner == pytest.approx(expected, abs=2 / 255)
    outside = shown.copy()
    outside[200 - margin - round(height) - 1 :, : margin + round(width) + 1] = 0.5
    assert np.abs(outside - 0.5).max() < 1 / 255
    frame = shown[200 - margin - round(height) - 1, margin : margin + round(width)]
    assert (frame == 1).all()


def _resized(picture: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    channels = (Image.fromarray(c.astype(np.float32)) for c in np.moveaxis(picture, -1, 0))
    return np.stack([np.asarray(c.resize(shape[::-1], 2)) for c in channels], -1)


def test_another_motion_has_nothing_of_the_recording_beside_it(capture) -> None:
    time_us = capture.frames[4].mid_us
    for motion in (Motion("walk"), Motion(angles=(0.0, 20.0))):
        request = ViewRequest(300, 200, BROWSER, time_us, motion=motion, events_us=WINDOW_US)
        assert np.abs(_composed(capture, request) - 0.5).max() < 1 / 255


@pytest.mark.parametrize("compare", [BLURRY, SHARP])
def test_a_recorded_picture_fills_its_box_left_of_the_divider(capture, compare: str) -> None:
    """With bars beside it that neither camera saw, darker."""
    frame = capture.frames[5]
    request = ViewRequest(160, 96, BROWSER, frame.mid_us + 1, "main", compare=compare, divider=0.45)
    shown = _composed(capture, request)
    recorded = capture.sharp(frame) if compare == SHARP else capture.image(frame)
    # 32 x 24 four times: 128 x 96 in the middle, shown up to the column 72
    expected = _resized(capture.shown(recorded).numpy(), (96, 128))
    assert shown[LABEL:, 16:71] == pytest.approx(expected[LABEL:, :55], abs=2 / 255)
    assert (shown[LABEL:, 71:73] == 1).all() and (shown[LABEL:, :16] == 0).all()
    assert shown[LABEL:, 73:144] == pytest.approx(0.5, abs=1 / 255)
    assert shown[LABEL:, 144:] == pytest.approx(0.5 * 0.45, abs=1 / 255)


def test_a_blurry_picture_in_the_place_of_a_sharp_one_is_named_as_such(
    tiny_capture, monkeypatch
) -> None:
    """Of frames without a sharp truth it was shown under that name."""
    path = tiny_capture()
    document = json.loads((path / "capture.json").read_text())
    del document["frames"][5]["sharp"]
    (path / "capture.json").write_text(json.dumps(document))
    capture, named = load_capture(path), []
    monkeypatch.setattr(
        compositor, "with_labels", lambda pixels, labels: named.append(labels[0][1]) or pixels
    )
    for frame in capture.frames[4:6]:
        _composed(capture, ViewRequest(160, 96, BROWSER, frame.mid_us, "main", compare=SHARP))
    assert named == [SHARP, f"{BLURRY}, no {SHARP}"]


def test_another_run_is_left_of_the_divider_or_beside_it(capture) -> None:
    time_us = capture.frames[2].mid_us
    for layout in ("divided", "side by side"):
        request = ViewRequest(
            120, 90, BROWSER, time_us, compare="other", layout=layout, divider=0.25
        )
        shown, middle = _composed(capture, request, other=0.2), 30 if layout == "divided" else 60
        assert shown.shape == (90, 120, 3)
        assert shown[LABEL:, : middle - 1] == pytest.approx(0.2, abs=1 / 255)
        assert (shown[LABEL:, middle - 1 : middle + 1] == 1).all()
        assert shown[LABEL:, middle + 1 :] == pytest.approx(0.5, abs=1 / 255)


def test_events_lie_where_the_recording_camera_saw_them(capture) -> None:
    """As wide and high as its picture in the viewport, by their polarity."""
    time_us = capture.frames[4].mid_us
    request = ViewRequest(128, 144, BROWSER, time_us, "main", events_us=WINDOW_US)
    shown = _composed(capture, request)[24:120].reshape(24, 4, 32, 4, 3)
    counts = _signed(capture, time_us)
    assert shown == pytest.approx(np.broadcast_to(shown[:, :1, :, :1], shown.shape), abs=1e-6)
    redder = shown[:, 0, :, 0, 0] - shown[:, 0, :, 0, 2]
    assert np.array_equal(np.sign(np.round(redder, 2)), np.sign(counts))


def test_a_run_that_is_gone_is_not_compared_with(capture) -> None:
    """In the corner stands the recording, as beside all that cannot be divided."""
    request = ViewRequest(64, 48, BROWSER, capture.frames[0].mid_us, compare="gone")
    shown = _composed(capture, request)
    assert shown[:30] == pytest.approx(0.5, abs=1 / 255) and shown[40, 10].std() > 0
