"""A recording of light is shown, searched and restored as the same recording coded as sRGB."""

import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from evsplat.camera import Camera
from evsplat.capture import Capture, Policy, coded, load_capture
from evsplat.evaluation import evaluate
from evsplat.film.looks import Look
from evsplat.inspection import inspect_capture
from evsplat.landmarks import sharp_pictures
from evsplat.pictures import decode, shown, stored
from evsplat.pictures.files import write_image
from evsplat.restore.network import NetworkRestorer

from ..conftest import write_tiny_capture
from ..evaluation.helpers import TruthWithNoise

STEP = 1.5 / 255
"""Pictures of the two differ by rounding alone: 8 bit against 16."""


@pytest.fixture(scope="module")
def recordings(tmp_path_factory) -> dict[str, Capture]:
    """A small recording coded as sRGB, and as the light that it stands for in 16 bit."""
    root = tmp_path_factory.mktemp("shown")
    small = write_tiny_capture(root / "small", frames=8, width=96, height=72)
    made = {}
    for kind in ("srgb", "linear"):
        path = Path(shutil.copytree(small, root / kind))
        document = json.loads((path / "capture.json").read_text())
        for camera in document["cameras"].values():
            camera["transfer"] = kind
        entries = [(entry, key) for entry in document["frames"] for key in ("image", "sharp")]
        entries += [(view, "image") for view in document["novel_views"]]
        for entry, key in entries if kind == "linear" else ():
            coded = np.asarray(Image.open(path / entry[key]).convert("RGB"), np.float32) / 255
            light = decode(torch.from_numpy(coded), "srgb").numpy()
            entry[key] = str(Path(entry[key]).with_suffix(".png"))
            write_image(path / entry[key], np.round(light * 65_535).astype(np.uint16))
        (path / "capture.json").write_text(json.dumps(document))
        made[kind] = load_capture(path)
    return made


def apart(one, other) -> float:
    return float(np.abs(np.asarray(one, np.float64) - np.asarray(other, np.float64)).max())


@pytest.mark.parametrize("transfer", ["power", "srgb", "linear"])
def test_what_is_shown_can_be_stored_again(transfer):
    values = torch.rand(1000, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(stored(shown(values, transfer), transfer), values)
    assert (shown(values, transfer) is values) == (transfer != "linear")


def test_pictures_of_light_are_coded_for_networks(recordings):
    plain, light = (recordings[kind].for_training(Policy()) for kind in ("srgb", "linear"))
    assert coded(plain) is plain
    given = coded(light)
    for frame in light.train_frames:
        assert given.transfer(frame) == "srgb"
        assert apart(given.image(frame), plain.image(frame.name)) < STEP
        assert apart(light.image(frame), plain.image(frame.name)) > 0.1
    # between the two in the middle, light has another mean
    backgrounds = given.median_background(), plain.median_background()
    assert float((backgrounds[0] - backgrounds[1]).abs().mean()) < 0.5 / 255


def test_sharp_pictures_of_light_are_coded(recordings):
    found = [sharp_pictures(capture.for_training(Policy())) for capture in recordings.values()]
    for one, other in zip(*found, strict=True):
        assert float((one.image - other.image).abs().mean()) < 0.25 / 255


class Brighter(NetworkRestorer):
    """A network that must be given coded pictures."""

    name, multiple, needs_events = "brighter", 4, False
    network = staticmethod(lambda picture: picture + 0.1)

    def __init__(self):
        self.device = torch.device("cpu")

    def load(self, path):
        raise NotImplementedError

    def inputs(self, capture, frame):
        return [capture.image(frame).permute(2, 0, 1)[None]]


def test_networks_restore_coded_pictures_and_give_light(recordings):
    captures = (recordings[kind].for_training(Policy()) for kind in ("srgb", "linear"))
    made = [dict(Brighter().restore(one, [one.train_frames[0]])) for one in captures]
    (sharp,), (bright,) = (list(one.values()) for one in made)
    assert apart(shown(bright, "linear"), sharp) < STEP
    assert apart(bright, sharp) > 0.1


def test_inspection_shows_the_same_pictures(recordings, tmp_path):
    for kind, capture in recordings.items():
        inspect_capture(capture.path, out_dir=tmp_path / kind)
    for name in ("contact_sheet.png", "body.png", "body_fit.png", "events.png"):
        one, other = (
            np.asarray(Image.open(tmp_path / kind / name), np.float64) for kind in recordings
        )
        rows = slice(70, None)  # below the title
        assert np.abs(one[rows] - other[rows]).mean() < 0.5, name


def test_pictures_of_an_evaluation_are_the_same(recordings, tmp_path):
    measured = {}
    for kind, capture in recordings.items():
        noisy = TruthWithNoise(capture, 0.0)
        measured[kind] = evaluate(capture, noisy, out_dir=tmp_path / kind)
    one, other = (
        np.asarray(Image.open(tmp_path / kind / m["per_frame"][0]["pictures"]["render"]), float)
        for kind, m in measured.items()
    )
    assert np.abs(one - other).max() <= 2


class Grey:
    """Draws one value, half covered."""

    def render(self, camera, times_us, parts="all"):
        size = (len(times_us), camera.height, camera.width)
        return SimpleNamespace(
            rgb=torch.full((*size, 3), 0.1), alpha=torch.full(size, 0.5), human=torch.ones(size)
        )


def test_films_code_light_behind_no_veil():
    camera = Camera(4, 4, torch.eye(3), torch.eye(4))
    (opaque,) = Look(transfer="linear").expose(Grey(), camera, [0])
    assert opaque[0, 0, 0] == round(255 * float(shown(torch.tensor(0.1), "linear")))
    (clear,) = Look(transparent=True, transfer="linear").expose(Grey(), camera, [0])
    assert clear[0, 0, 0] == round(255 * float(shown(torch.tensor(0.2), "linear")))
    (coded,) = Look(transparent=True).expose(Grey(), camera, [0])
    assert coded[0, 0, 0] == 51 and coded[0, 0, 3] == 128
