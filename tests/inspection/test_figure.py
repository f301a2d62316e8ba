"""The posed body in maps: where its samples lie, without the gaps between them."""

import numpy as np
import torch
from scipy.ndimage import binary_closing

from evsplat.camera import Camera
from evsplat.capture import load_body_track, load_capture
from evsplat.inspection.figure import Coarse, Figure


def test_gaps_are_closed_as_scipy_closes_them_and_times_are_drawn_alike_together(
    rng: np.random.Generator, tiny_capture, monkeypatch
):
    capture = load_capture(tiny_capture(seed=int(rng.integers(10_000))))
    figure = Figure(load_body_track(capture))
    camera = capture.camera(capture.frames[0])
    coarse, margin = Coarse(camera.width, camera.height, 1.0), int(rng.integers(0, 6))
    times = rng.integers(-50_000, 500_000, 5).tolist()
    places = []
    project = Camera.project
    monkeypatch.setattr(
        Camera, "project", lambda *given: places.append(project(*given)) or places[-1]
    )
    maps = figure.maps(times, [camera] * 5, coarse, margin)
    alone = [figure.maps([time], [camera], coarse, margin)[0] for time in times]
    assert np.array_equal(maps, alone) and maps.any((1, 2)).all()
    for found, (pixels, depth) in zip(maps, places, strict=False):
        assert bool((depth > 0).all())
        dots = np.zeros((camera.height + 200, camera.width + 200), bool)
        column, row = torch.floor(pixels).int().T.numpy() + 100
        dots[row, column] = True
        closed = binary_closing(dots, np.ones((3, 3)))
        around = slice(100 - margin, 100 + camera.height + margin)
        across = slice(100 - margin, 100 + camera.width + margin)
        assert np.array_equal(found, closed[around, across])
