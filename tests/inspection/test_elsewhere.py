"""`find_elsewhere`, what `train` and `inspect` say by it, and its picture."""

import json
import logging
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from evsplat.capture import Policy, load_capture
from evsplat.inspection import check_body, fit_sheet, inspect_capture, judge_body
from evsplat.inspection.elsewhere import Elsewhere, find_elsewhere
from evsplat.pictures.files import write_image
from evsplat.pictures.light import Transfer, decode, encode

FRAMES, HEIGHT, WIDTH = 16, 60, 90
Film = tuple[np.ndarray, np.ndarray]


def film(seed: int) -> Film:
    """A textured scene before which a body steps from side to side; where it is."""
    rng = np.random.default_rng(seed)
    scene = rng.uniform(0.2, 0.8, (3, HEIGHT, WIDTH))
    pictures = np.repeat(scene[None], FRAMES, axis=0) + rng.normal(0, 0.01, (FRAMES, 1, 1, 1))
    pictures += rng.normal(0, 0.01, pictures.shape)
    body = np.zeros((FRAMES, HEIGHT, WIDTH), bool)
    for k, left in enumerate(rng.integers(30, 42, FRAMES)):
        body[k, 12:52, left : left + 12] = True
        pictures[k, :, body[k]] = rng.uniform(0, 1, 3)
    return pictures.astype(np.float32).clip(0, 1), body


def found(pictures: np.ndarray, body: np.ndarray) -> Elsewhere | None:
    changes = np.abs(pictures - np.median(pictures, axis=0)).max(1)
    return find_elsewhere(pictures, {"frames": changes}, body, (2 * WIDTH, 2 * HEIGHT))


def with_screen(pictures: np.ndarray, seed: int, frames: int = FRAMES) -> np.ndarray:
    """Colours that change from picture to picture in the first ``frames``, at the upper right."""
    shown = pictures.copy()
    shown[:frames, :, 6:18, 70:84] = np.random.default_rng(seed).uniform(0, 1, (frames, 3, 1, 1))
    return shown


@pytest.mark.parametrize("seed", range(5))
def test_place_that_changes_its_colours_is_found_where_it_is(seed: int) -> None:
    pictures, body = film(seed)
    told = found(with_screen(pictures, seed), body)
    assert told is not None
    # maps hold two pixels of the picture each, to which noise may add one
    assert np.allclose(told.box_px, (140, 12, 168, 36), atol=4)
    assert "at the upper right, 1" in told.where
    assert told.looked_at == FRAMES and told.frames > FRAMES / 2
    assert 0.05 < dict(told.shares)["frames"] < 0.95


@pytest.mark.parametrize("seed", range(5))
def test_body_its_shadow_and_light_that_changes_are_not_told(seed: int) -> None:
    pictures, body = film(seed)
    assert found(pictures, body) is None
    rng = np.random.default_rng(seed)
    for k in range(FRAMES):
        # a shadow wanders over the floor and the wall, away from the body; lamps flicker
        left, depth = int(rng.integers(0, 60)), rng.uniform(0.55, 0.8)
        pictures[k, :, 53:60, left : left + 30] *= depth
        pictures[k, :, 2:10, left : left + 15] *= depth
        pictures[k] *= rng.uniform(0.8, 1.2)
    assert found(pictures.clip(0, 1), body) is None


@pytest.mark.parametrize("seed", range(3))
def test_hair_cloth_and_poses_that_are_off_are_the_body(seed: int) -> None:
    pictures, body = film(seed)
    for right, down in ((3, 0), (-3, 1), (0, 3)):
        assert found(pictures, np.roll(body, (down, right), axis=(1, 2))) is None


def test_what_changes_in_few_pictures_is_not_told_and_neither_are_few_pictures() -> None:
    pictures, body = film(0)
    assert found(with_screen(pictures, 0, frames=3), body) is None
    assert found(with_screen(pictures, 0)[:7], body[:7]) is None
    assert found(with_screen(pictures, 0), np.zeros_like(body)) is None


@pytest.fixture
def path(tiny_capture: Callable[..., Path]) -> Path:
    return tiny_capture(frames=20, width=96, height=72)


def with_screen_in(path: Path) -> Path:
    rng = np.random.default_rng(5)
    for file in sorted((path / "images").iterdir()):
        with Image.open(file) as image:
            pixels = np.asarray(image).copy()
        pixels[4:18, 4:20] = rng.integers(0, 256, 3)
        Image.fromarray(pixels).save(file)
    return path


def test_warnings_say_where_it_is_and_what_comes_of_it(
    path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING, logger="evsplat.inspection"):
        check_body(load_capture(path).for_training(Policy()), refuse=True)
        assert caplog.messages == []
        found = check_body(load_capture(with_screen_in(path)).for_training(Policy()), refuse=True)
    assert found.verdict == "belongs" and found.is_odd
    (said,) = caplog.messages
    assert "images: found something that moves or changes beside the person, at the upper" in said
    assert "the mean of what was seen" in said and "Crop" in said


@pytest.mark.parametrize("transfer", ["srgb", "linear"])
def test_a_shadow_is_one_whether_values_are_coded_or_light(
    path: Path, rng: np.random.Generator, transfer: Transfer
) -> None:
    """It comes and goes at the upper left, and takes half of the coded values, or less."""
    for file in sorted((path / "images").iterdir()):
        with Image.open(file) as image:
            coded = np.asarray(image) / 255
        coded[4:18, 4:20] = 0.7 * rng.choice([1, rng.uniform(0.5, 0.6)])
        light = decode(torch.from_numpy(coded), "srgb")
        values = np.round(65535 * encode(light, transfer).numpy()).astype(np.uint16)
        write_image(file, values)
    document = json.loads((path / "capture.json").read_text())
    document["cameras"]["main"]["transfer"] = transfer
    (path / "capture.json").write_text(json.dumps(document))
    found = judge_body(load_capture(path).for_training(Policy()))
    assert found.verdict == "belongs" and found.elsewhere is None


def test_inspect_warns_and_draws_the_place(path: Path, tmp_path: Path) -> None:
    report = inspect_capture(with_screen_in(path), tmp_path / "out")
    (finding,) = [finding for finding in report.findings if finding.file.name == "images"]
    assert "something that moves" in finding.found and finding.severity == "warning"
    capture = load_capture(path).for_training(Policy())
    drawn = np.asarray(fit_sheet(capture, judge_body(capture)))
    assert (drawn == (255, 110, 220)).all(-1).sum() > 100
    assert (tmp_path / "out" / "body_fit.png").exists()


def test_moving_camera_is_not_judged(path: Path) -> None:
    document = json.loads((with_screen_in(path) / "capture.json").read_text())
    for index, frame in enumerate(document["frames"]):
        pose = np.array(document["cameras"]["main"]["world_to_camera"])
        pose[0, 3] += 0.002 * index
        frame["world_to_camera"] = pose.tolist()
    (path / "capture.json").write_text(json.dumps(document))
    found = judge_body(load_capture(path).for_training(Policy()))
    assert not found.standing_camera and found.elsewhere is None
    assert "it has no events" not in found.sentence
    del document["events"]
    (path / "capture.json").write_text(json.dumps(document))
    blind = judge_body(load_capture(path).for_training(Policy()))
    assert blind.verdict == "unknown" and blind.sentence.endswith("and it has no events")
