"""Pictures of an automatic exposure: read, derived and blurred as if the camera had been steady."""

import logging
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from evsplat.calibration.gain import GainMeter
from evsplat.capture import Capture, CaptureWriter, load_capture
from evsplat.capture.derive import derived_capture
from evsplat.errors import DataError
from evsplat.importers import import_capture
from evsplat.pictures.files import read_image, write_image
from evsplat.pictures.light import decode, encode
from evsplat.synthesis import synthesize

from .editing import edit

Factory = Callable[..., Path]
GAINS = [1.0, [0.9, 0.8, 0.7], 0.6]


def edit_frames(path: Path, change) -> Path:
    return edit(path, lambda document: change(document["frames"]))


@pytest.fixture
def pair(tiny_capture: Factory, tmp_path: Path) -> tuple[Capture, Capture]:
    """One recording by a steady camera, and by one that changes its gain."""
    steady, changed = (tiny_capture(name=name) for name in ("steady", "changed"))
    for i, frame in enumerate(load_capture(changed).frames):
        gain = torch.tensor(GAINS[i % 3])
        for file in (frame.image, frame.sharp):
            light = decode(torch.from_numpy(read_image(file) / 255.0)) * gain
            # 16 bits, so that only what is read is tested
            write_image(file, np.uint16(np.round(encode(light).numpy() * 65_535)))

    def give(frames) -> None:
        for i, frame in enumerate(frames):
            frame["gain"] = GAINS[i % 3]

    return load_capture(steady), load_capture(edit_frames(changed, give))


def alike(ours: torch.Tensor, theirs: torch.Tensor, tolerance: float = 2e-3) -> bool:
    return float((ours - theirs).abs().max()) < tolerance


def test_pictures_and_truth_are_read_as_of_a_steady_camera(pair) -> None:
    steady, changed = pair
    for frame in steady.frames:
        assert alike(changed.image(frame.name), steady.image(frame))
        assert alike(changed.sharp(frame.name), steady.sharp(frame))
    assert alike(changed.median_background(), steady.median_background())


def test_what_is_clipped_stays_so(pair) -> None:
    _, changed = pair
    frame = changed.frames[2]
    write_image(frame.image, np.full(read_image(frame.image).shape, 65_535, np.uint16))
    assert (load_capture(changed.path).image(frame.name) == 1.0).all()


def test_a_derived_capture_has_one_brightness(pair, tmp_path: Path) -> None:
    steady, changed = pair
    with derived_capture(changed, tmp_path / "new", without=("image",)) as making:
        for frame in changed.frames:
            making.set_picture(frame, "image", changed.image(frame))
    derived = load_capture(tmp_path / "new")
    assert not any(frame.gain for frame in derived.frames)
    for frame in steady.frames:
        assert alike(derived.image(frame.name), steady.image(frame), 6e-3)
        assert alike(derived.sharp(frame.name), steady.sharp(frame), 6e-3)


@pytest.mark.parametrize("bad", [0, -1, [1, 2], "bright", float("nan"), 1e9, [1, 0, 1]])
def test_bad_gains_are_named(tiny_capture: Factory, bad) -> None:
    path = edit_frames(tiny_capture(), lambda frames: frames[3].update(gain=bad))
    with pytest.raises(DataError, match=r"capture\.json: frames\[3\]\.gain: found"):
        load_capture(path)


def test_gains_of_three_colours_in_a_grey_picture_are_named(tiny_capture: Factory) -> None:
    path = edit_frames(tiny_capture(), lambda frames: frames[3].update(gain=[1, 1, 0.9]))
    capture = load_capture(path)
    frame = capture.frames[3]
    write_image(frame.image, read_image(frame.image)[..., 0])
    with pytest.raises(DataError, match="is grey and has a gain of 3 colours"):
        capture.image(frame)


@pytest.mark.parametrize("changes", [False, True])
def test_import_finds_gains_and_says_so(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, changes: bool
) -> None:
    rng = np.random.default_rng(int(changes))
    scene = np.kron(rng.uniform(0.1, 0.8, (6, 8, 3)), np.ones((8, 8, 1)))
    gains = 1 - 0.3 * changes * np.linspace(0, 1, 12)
    source = tmp_path / "source"
    (source / "images").mkdir(parents=True)
    for i, gain in enumerate(gains):
        light = scene * gain
        light[10:30, 4 * i : 4 * i + 10] = 0.1
        write_image(source / f"images/{i:03d}.png", light ** (1 / 2.2))
    with caplog.at_level(logging.INFO):
        out = import_capture(
            "folder", source, tmp_path / "out", fps=20.0, exposure_us=20_000.0, no_poses=True
        )
    capture = load_capture(out, needs_body=False)
    told = [message for message in caplog.messages if message.startswith("light: ")]
    assert len(told) == changes
    for frame, gain in zip(capture.frames, gains / gains[1], strict=True):
        assert (frame.gain or (1.0,) * 3) == pytest.approx([gain] * 3, abs=0.01)
    if changes:
        assert "1.43 times as bright" in told[0]
    assert not [message for message in caplog.messages if "three quarters" in message]


def test_a_gain_that_is_given_is_kept(tiny_capture: Factory, tmp_path: Path) -> None:
    source = load_capture(tiny_capture())
    camera = source.camera(source.frames[0])
    with CaptureWriter(tmp_path / "given", gains=True) as writer:
        writer.add_camera("main", camera.width, camera.height, camera.K)
        for i, frame in enumerate(source.frames):
            pixels = np.uint8(read_image(frame.image) * (1 - 0.3 * (i % 2)))
            writer.add_frame(frame.name, "main", pixels, frame.exposure_us, gain=[0.5, 1, 1])
        assert writer.find_gains() == 1.0
        writer.leave_out_body()
    kept = load_capture(tmp_path / "given", needs_body=False)
    assert {frame.gain for frame in kept.frames} == {(0.5, 1.0, 1.0)}


@pytest.mark.parametrize("changes", [False, True])
def test_gains_of_a_camera_that_moves_are_found(tmp_path: Path, changes: bool) -> None:
    rng = np.random.default_rng(int(changes))
    wall = np.kron(rng.uniform(0.1, 0.8, (8, 20, 3)), np.ones((8, 8, 1)))
    gains = 1 - 0.4 * changes * np.linspace(0, 1, 14)
    with CaptureWriter(tmp_path / "on_the_way", gains=True) as writer:
        writer.add_camera("main", 96, 64, [[90, 0, 48], [0, 90, 32], [0, 0, 1]])
        for i, gain in enumerate(gains):
            pose = np.eye(4)
            pose[0, 3] = -0.1 * i
            pixels = np.uint8(255 * encode(torch.from_numpy(gain * wall[:, 3 * i : 3 * i + 96])))
            writer.add_frame(
                f"{i:02d}", "main", pixels, (50_000 * i, 50_000 * i + 20_000), world_to_camera=pose
            )
        factor = writer.find_gains()
        writer.leave_out_body()
    capture = load_capture(tmp_path / "on_the_way", needs_body=False)
    assert factor == pytest.approx(1 / gains[-1], rel=0.04)
    for frame, gain in zip(capture.frames, gains / gains[0], strict=True):
        assert (frame.gain or (1.0,) * 3) == pytest.approx([gain] * 3, rel=0.05)


def test_only_a_writer_that_is_asked_to_looks_at_pictures(
    tiny_capture: Factory, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    looked = []
    monkeypatch.setattr(GainMeter, "add", lambda *given: looked.append(given))
    tiny_capture()
    with (
        pytest.raises(DataError, match=r"other: the pictures were not looked .* gains=True"),
        CaptureWriter(tmp_path / "other") as writer,
    ):
        writer.find_gains()
    assert not looked and not (tmp_path / "other").exists()


def test_blur_is_synthesized_of_evened_pictures(pair, tmp_path: Path) -> None:
    steady, changed = pair
    made = [
        synthesize(source.path, tmp_path / f"{source.name}-blurry-{i}", events="none")
        for i, source in enumerate((steady, changed))
    ]
    one, other = (load_capture(path) for path in made)
    for frame in one.frames:
        assert alike(other.image(frame.name), one.image(frame), 8e-3)
