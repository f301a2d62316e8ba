"""The trivial rows, also against the figures published with the shared captures."""

import numpy as np
import pytest
import torch
from PIL import Image

from evsplat.capture import load_capture
from evsplat.errors import DataError
from evsplat.evaluation.protocols import METRICS, REGIONS, STANDARD, Absent, Truth
from evsplat.evaluation.regions import HumanRegions
from evsplat.methods.trivial import MedianBackground, NearestFrame, nearest_in_time

NO_NETWORKS = dict.fromkeys(METRICS[2:], Absent("not needed"))

# PSNR full / person crop / person mask from the README of the shared captures: median background,
# nearest training frame, the camera's own blurry frame.
PUBLISHED = {
    "woman_dance_b_256": [(24.41, 18.82, 13.24), (28.52, 22.81, 18.77), (40.71, 34.99, 29.71)],
    "worker_punch_256": [(22.46, 16.81, 11.75), (28.39, 22.63, 18.82), (41.69, 35.90, 31.82)],
    "man_dance_hard_256": [(23.97, 18.31, 13.21), (25.44, 19.70, 15.83), (34.54, 28.73, 24.71)],
    "real_beam_256": [(21.67, 19.54, 13.92), (26.22, 24.07, 19.18), (34.40, 32.24, 27.10)],
    "real_beam_512": [(21.51, 19.40, 13.76), (25.91, 23.79, 18.85), (33.68, 31.56, 26.35)],
}


@pytest.mark.parametrize("name", PUBLISHED)
def test_published_figures_are_reproduced(captures_root, name):
    if not (captures_root / name).is_dir():
        pytest.skip(f"no capture {name} there")
    capture = load_capture(captures_root / name)
    rows = (MedianBackground(capture), NearestFrame(capture))
    people = HumanRegions(capture)
    totals = torch.zeros(3, 3, dtype=torch.float64)
    for frame in capture.test_frames:
        mask, box = people.in_frame(frame)
        truth = Truth(STANDARD, capture.sharp(frame), mask, box, NO_NETWORKS)
        pictures = [row.render(capture.camera(frame), [frame.mid_us]).rgb[0] for row in rows]
        for number, picture in enumerate([*pictures, capture.image(frame)]):
            measured = truth.measure(picture)
            totals[number] += torch.tensor([measured[region]["psnr"] for region in REGIONS])
    means = totals / len(capture.test_frames)
    # The published figures have two decimals; medians that end in one half may round either way.
    assert (means - torch.tensor(PUBLISHED[name]).double()).abs().max() < 0.01


def test_median_background_is_numpys_median_of_the_training_frames(tiny_capture):
    path = tiny_capture(frames=12, seed=3)
    capture = load_capture(path)
    files = [path / "images" / f"{i:04d}.png" for i in range(12) if i % 10 < 7]
    expected = np.median([np.asarray(Image.open(file)) for file in files], axis=0) / 255
    drawn = MedianBackground(capture).render(capture.camera(capture.frames[0]), [0, 99])
    assert drawn.rgb.shape == (2, 24, 32, 3)
    np.testing.assert_allclose(drawn.rgb[1], expected, atol=1e-6)
    assert drawn.alpha.min() == 1 and drawn.human.max() == 0


def test_nearest_frame_never_draws_a_test_frame_and_takes_the_earlier_of_two(tiny_capture):
    capture = load_capture(tiny_capture(frames=12))
    by_index = {frame.index: frame for frame in capture.frames}
    # frames 7, 8, 9 are held out: 8 is equally far from 6 and 10
    for held_out, nearest in ((7, 6), (8, 6), (9, 10)):
        time = by_index[held_out].mid_us
        assert nearest_in_time(capture.train_frames, time).index == nearest
        drawn = NearestFrame(capture).render(capture.camera(by_index[held_out]), [time])
        assert torch.equal(drawn.rgb[0], capture.image(by_index[nearest]))


def test_parts_are_black_where_nothing_is_known_to_be_the_person(tiny_capture):
    capture = load_capture(tiny_capture())
    view = capture.camera(capture.frames[0])
    person = NearestFrame(capture).render(view, [0], parts="human")
    assert person.rgb.abs().max() == 0 and person.alpha.max() == 0


def test_a_median_of_large_pictures_takes_no_more_memory_than_it_may(
    rng, tiny_capture, monkeypatch
):
    """255 pictures of 4k would be 6 GB; so many are taken, evenly spread, that the limit holds."""
    monkeypatch.setattr("evsplat.capture.read._LEAST_MEDIAN_FRAMES", 1)
    monkeypatch.setattr("evsplat.capture.read._MEDIAN_BYTES", 5 * 24 * 32 * 3 + 7)
    capture = load_capture(tiny_capture(frames=20, seed=int(rng.integers(99))))
    train = capture.train_frames
    frames = [train[round(k * (len(train) - 1) / 4)] for k in range(5)]
    stack = np.stack([np.array(Image.open(frame.image)) for frame in frames])
    expected = np.median(stack, axis=0) / 255
    assert np.abs(capture.median_background().numpy() - expected).max() < 1e-6


def test_median_background_refuses_another_camera(tiny_capture):
    capture = load_capture(tiny_capture())
    with pytest.raises(DataError, match="recording camera"):
        MedianBackground(capture).render(capture.cameras["side"], [0])
