"""Places that shadows fall on: the scene's without the person, kept while nothing changes."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from evsplat.capture import load_capture
from evsplat.models import scene_places
from evsplat.models.scene_places import ScenePlaces, places_of, scene_depth

from ..small_model import built


@pytest.fixture
def posed(tiny_capture):
    """Layers of a model at two times, and the camera."""
    capture = load_capture(tiny_capture())
    model = built("evsplat", capture, "lamps=2").model
    camera = capture.camera(capture.train_frames[0])
    times = [frame.mid_us for frame in capture.train_frames[:2]]
    with torch.no_grad():
        return model.at(times, camera.center()), camera


@pytest.fixture
def drawings(monkeypatch):
    """Counts how often the scene's depth is drawn."""
    counted = []

    def count(*given):
        counted.append(given)
        return scene_depth(*given)

    monkeypatch.setattr(scene_places, "scene_depth", count)
    return counted


def moved(layers, by):
    return replace(layers, scene=replace(layers.scene, means=layers.scene.means + by))


def test_places_are_kept_until_scene_or_camera_change(posed, drawings):
    layers, camera = posed
    places = ScenePlaces()
    first = places.of(layers, camera, 2)
    assert torch.equal(first, places_of(scene_depth(layers, camera), camera, 2))
    again = replace(layers, human=replace(layers.human, means=layers.human.means + 1))
    assert places.of(again, camera, 2) is first and len(drawings) == 1
    assert not torch.equal(places.of(moved(layers, 0.01), camera, 2), first)
    K = camera.K * torch.tensor([[1.1], [1.0], [1.0]])
    places.of(moved(layers, 0.01), replace(camera, K=K), 2)
    places.of(moved(layers, 0.01), replace(camera, K=K), 4)
    assert len(drawings) == 4


def test_places_of_a_scene_that_learns_are_drawn_anew_now_and_then(posed, drawings):
    layers, camera = posed
    places = ScenePlaces(refresh=3)
    for step in range(5):
        places.of(moved(layers, 0.01 * step), camera, 2)
    assert len(drawings) == 2
    resumed = ScenePlaces(refresh=3)
    resumed.load_state(places.state())
    assert torch.equal(resumed.of(layers, camera, 2), places.of(layers, camera, 2))
    assert len(drawings) == 2
    resumed.rows_changed()
    resumed.of(layers, camera, 2)
    assert len(drawings) == 3


def test_two_cameras_at_rest_have_their_own_places_in_whatever_order_they_come(posed, rng):
    layers, camera = posed
    aside = camera.world_to_camera.clone()
    aside[0, 3] += 0.5
    cameras = [camera, replace(camera, world_to_camera=aside)]
    expected = [places_of(scene_depth(layers, each), each, 2) for each in cameras]
    assert not torch.equal(*expected)
    places = ScenePlaces(refresh=3)
    # Often the same one again, until what is kept has grown old.
    for which in np.repeat(rng.integers(0, 2, 40), rng.integers(1, 5, 40)):
        assert torch.equal(places.of(layers, cameras[which], 2), expected[which])
