"""Person masks: where the person is, soft, paired by name, never at the cost of other masks."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from evsplat.body import silhouette
from evsplat.capture import Capture, load_body_track, load_capture, validate_capture
from evsplat.capture.derive import write_picture
from evsplat.errors import ConfigError, DataError, OutputError
from evsplat.masks import MASKERS, mask_capture
from evsplat.masks.background import clean, difference
from evsplat.masks.silhouette import soft_silhouette

from ..seen import seen

Factory = Callable[..., Path]


def _without_masks(path: Path) -> Path:
    shutil.rmtree(path / "masks")
    document = json.loads((path / "capture.json").read_text())
    for entry in document["frames"]:
        del entry["mask"]
    (path / "capture.json").write_text(json.dumps(document))
    return path


def _overlap(found: torch.Tensor, truth: torch.Tensor) -> float:
    one, other = found > 0.5, truth > 0.5
    return float((one & other).sum() / (one | other).sum())


def _overlaps(made: Capture, truth: Capture) -> list[float]:
    return [
        _overlap(made.mask(frame.name), truth.mask(frame))  # type: ignore[arg-type]
        for frame in truth.frames
    ]


@pytest.mark.parametrize(("method", "least"), [("background", 0.65), ("silhouette", 0.9)])
def test_masks_lie_on_the_person(tiny_capture: Factory, tmp_path: Path, method, least) -> None:
    path = tiny_capture(width=96, height=72)
    out = mask_capture(path, tmp_path / "masked", method=method)
    made = load_capture(out)
    assert validate_capture(out) == []
    assert min(_overlaps(made, load_capture(path))) > least
    assert made.provenance["masks"]["with"] == method
    mask = made.mask(made.frames[0])
    assert 0 < float(((mask > 0.05) & (mask < 0.95)).float().mean()) < 0.3


def test_background_keeps_away_from_shadows_and_other_movers(tiny_capture: Factory) -> None:
    """A shadow (all channels halved) and a red ball come and go beside the person."""
    capture = load_capture(tiny_capture(width=96, height=72))
    background = capture.median_background()
    image = background.clone()
    image[40:60, 5:25] *= 0.7 ** (1 / 2.2)
    image[5:15, 80:90] = torch.tensor([0.9, 0.1, 0.1])
    image[20:50, 40:56] = torch.tensor([0.1, 0.2, 0.9])
    differs = difference(image, background, 0.08)
    assert not differs[42:58, 7:23].any()
    assert differs[22:48, 42:54].all() and differs[6:14, 81:89].all()
    body = np.zeros((72, 96), dtype=bool)
    body[18:52, 44:52] = True
    person = clean(differs, body)
    assert person[21:49, 42:54].all() and not person[:16, 78:].any()
    assert not clean(differs, np.zeros_like(body)).any()
    largest = clean(differs, None)
    assert largest[21:49, 42:54].all() and not largest[:16, 78:].any()


@pytest.mark.parametrize("channel", [0, 1, 2])
def test_what_differs_by_less_than_the_threshold_in_each_channel_is_the_background(channel) -> None:
    background = 0.2 + 0.5 * torch.rand(20, 30, 3, generator=torch.Generator().manual_seed(channel))
    image = background.clone()
    image[:, 10:20, channel] += 0.07  # brighter: no shadow
    image[:, 20:, channel] += 0.09
    differs = difference(image, background, 0.08)
    assert not differs[:, :20].any() and differs[:, 20:].all()


def test_the_middle_of_the_body_is_the_person_even_where_nothing_differs() -> None:
    body = np.zeros((40, 40), dtype=bool)
    body[5:35, 10:30] = True
    person = clean(np.zeros_like(body), body)
    assert person[8:32, 13:27].all() and not person[~body].any()


@pytest.mark.parametrize("margin_px", [0.0, 2.0, 3.5])
def test_silhouette_is_soft_and_as_wide_as_asked(tiny_capture: Factory, margin_px: float) -> None:
    capture = load_capture(tiny_capture(width=96, height=72))
    track, frame = load_body_track(capture), capture.frames[3]
    camera = capture.camera(frame)
    hard = silhouette(track.vertices(frame.mid_us), track.body.faces, camera).numpy()
    soft = soft_silhouette(track, frame.mid_us, camera, margin_px=margin_px).numpy()
    assert set(np.unique(np.round(soft * 16, 6))) <= set(range(17))
    y, x = np.mgrid[:72, :96]
    inside = np.argwhere(hard)
    distance = np.sqrt(((np.stack([y, x], -1)[:, :, None] - inside) ** 2).sum(-1)).min(-1)
    # A pixel's diagonal is the most that the two grids can differ by.
    assert (soft[distance < margin_px - 1.5] == 1).all()
    assert (soft[distance > margin_px + 1.5] == 0).all()


def test_in_place_adds_masks_and_never_replaces_others(tiny_capture: Factory) -> None:
    path = tiny_capture()
    with pytest.raises(DataError, match="masks already.*--out"):
        mask_capture(path, method="silhouette")
    _without_masks(path)
    before = {file: file.read_bytes() for file in path.rglob("*.png")}
    assert mask_capture(path, method="silhouette") == path
    assert validate_capture(path) == []
    first = load_capture(path)
    assert all(frame.mask is not None for frame in first.frames)
    mask_capture(path, method="silhouette", margin_px=2.0)
    second = load_capture(path)
    assert second.provenance["masks"]["margin_px"] == 2.0
    assert float(second.mask("0000").sum()) > float(first.mask("0000").sum())
    assert all(file.read_bytes() == content for file, content in before.items())


def test_where_the_description_cannot_be_written_no_masks_are_left(
    tiny_capture: Factory, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(path: Path, value: object) -> None:
        raise OutputError(f"{path}: no room.")

    path = _without_masks(tiny_capture())
    before = sorted(path.rglob("*"))
    with monkeypatch.context() as patch:
        patch.setattr("evsplat.masks.capture.write_json", full)
        with pytest.raises(OutputError, match=r"capture\.json: no room"):
            mask_capture(path, method="silhouette")
    assert sorted(path.rglob("*")) == before


def test_a_description_that_was_changed_meanwhile_stays(
    tiny_capture: Factory, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = _without_masks(tiny_capture())
    description = path / "capture.json"
    changed = json.loads(description.read_text()) | {"provenance": {"by": "somebody else"}}
    write = write_picture

    def written(*arguments: object) -> None:
        description.write_text(json.dumps(changed))
        write(*arguments)

    before = sorted(path.rglob("*"))
    monkeypatch.setattr("evsplat.masks.capture.write_picture", written)
    with pytest.raises(DataError, match=r"capture\.json: was changed while masks were made"):
        mask_capture(path, method="silhouette")
    assert json.loads(description.read_text()) == changed
    assert sorted(path.rglob("*")) == before


def test_stopping_midway_changes_nothing(
    tiny_capture: Factory, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Stopped:
        name = "stopped"

        def __init__(self, capture):
            pass

        def masks(self, capture, frames):
            yield frames[0], torch.zeros(24, 32)
            raise KeyboardInterrupt

        def provenance(self):
            return {}

    monkeypatch.setitem(MASKERS, "stopped", Stopped)
    path = _without_masks(tiny_capture())
    before = {file: file.read_bytes() for file in path.rglob("*") if file.is_file()}
    for out in (None, tmp_path / "out" / "masked"):
        with pytest.raises(KeyboardInterrupt):
            mask_capture(path, out, method="stopped")
    assert {file: file.read_bytes() for file in path.rglob("*") if file.is_file()} == before
    assert not (tmp_path / "out").exists()


def test_bad_options_are_named(tiny_capture: Factory, tmp_path: Path) -> None:
    path = tiny_capture()
    for options, words in (
        ({"method": "sam"}, "sam.*background"),
        ({"method": "background", "threshold": 2.0}, "between 0 and 1"),
        ({"method": "silhouette", "margin_px": -1.0}, "0 or more"),
        ({"method": "silhouette", "margin_px": float("nan")}, "0 or more"),
        ({"method": "silhouette", "margin_px": float("inf")}, "0 or more"),
    ):
        with pytest.raises(ConfigError, match=words):
            mask_capture(path, tmp_path / "out", **options)
    document = json.loads((path / "capture.json").read_text())
    pose = document["cameras"]["main"]["world_to_camera"]
    moved = [pose[0][:3] + [pose[0][3] + 0.1], *pose[1:]]
    document["frames"][0]["world_to_camera"] = moved
    (path / "capture.json").write_text(json.dumps(document))
    with pytest.raises(
        DataError, match="moving camera.*evsplat masks .*--with silhouette, or --with rvm"
    ):
        mask_capture(path, tmp_path / "out", method="background")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["woman_dance_b_256"])
def test_overlap_with_the_true_masks_of_a_shared_capture(captures_root: Path, name: str) -> None:
    """All of the table in docs/masks.md comes from benchmarks/masks.py; this is its alarm."""
    capture = load_capture(captures_root / name)
    for method, least in (("background", 0.82), ("silhouette", 0.87)):
        training = seen(capture)
        found = MASKERS[method](training).masks(training, training.train_frames[::5])
        overlaps = [
            _overlap(mask, capture.mask(frame))  # type: ignore[arg-type]
            for frame, mask in found
        ]
        assert np.mean(overlaps) > least


def test_what_differs_beside_a_thin_body_is_nobody(rng: np.random.Generator) -> None:
    """An arm alone is in view: it has no middle, and what moves beside it covers none of it."""
    body, differs = np.zeros((2, 96, 80), bool)
    left, width = int(rng.integers(10, 60)), int(rng.integers(1, 4))
    body[10:90, left : left + width] = True
    differs[20:70, left + width + 1 : left + width + 5] = True
    assert not clean(differs, body).any()
