"""Writing captures: what goes in comes out, and nothing half-written is left."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from evsplat.capture import CaptureWriter, load_body_track, load_capture, validate_capture
from evsplat.errors import DataError
from evsplat.events import EventStream

Factory = Callable[..., Path]
WIDTH, HEIGHT = 20, 14
K = [[30.5, 0, 10.25], [0, 31.0, 7.5], [0, 0, 1]]


def shifted(x: float) -> np.ndarray:
    pose = np.eye(4)
    pose[0, 3] = x
    return pose


def add_body(writer: CaptureWriter, frames: int) -> None:
    times = np.arange(frames) * 40_000 + 15_000
    writer.set_body("default", times, np.zeros((frames, 31, 3)), np.zeros((frames, 3)), betas=[0.5])


def write_small(path: Path, frames: int = 10, **options) -> None:
    """A capture without events."""
    with CaptureWriter(path, **options) as writer:
        writer.add_camera("main", WIDTH, HEIGHT, K)
        for index in range(frames):
            picture = np.full((HEIGHT, WIDTH, 3), index / frames)
            start = index * 40_000
            writer.add_frame(f"{index:04d}", "main", picture, (start, start + 30_000))
        add_body(writer, frames)


def test_a_capture_written_anew_is_the_same(tiny_capture: Factory, tmp_path: Path) -> None:
    """Every part of a capture of the other writer (tests/conftest.py) goes through this one."""
    before = load_capture(tiny_capture(frames=12, seed=4))
    body, events = before.body_file, before.events
    assert events is not None
    first, last = events.time_range_us
    edges = [first, *range(37_000, last, 61_000), last]
    rng = np.random.default_rng(0)
    points, colours = rng.normal(size=(9, 3)), rng.integers(0, 256, (9, 3)) / 255
    with CaptureWriter(tmp_path / "again", "tiny") as writer:
        for name, camera in before.cameras.items():
            writer.add_camera(name, camera.width, camera.height, camera.K, camera.world_to_camera)
        for frame in before.frames:
            moved = shifted(0.5) if frame.index == 3 else None
            # a file, floats and 8 bit: all three ways a picture comes
            mask = before.mask(frame)
            assert mask is not None
            sharp = (before.sharp(frame).numpy() * 255).round().astype(np.uint8)
            writer.add_frame(
                frame.name,
                frame.camera,
                frame.image,
                frame.exposure_us,
                split=frame.split,
                sharp=sharp,
                mask=mask.numpy(),
                world_to_camera=moved,
            )
        for view in before.novel_views:
            writer.add_novel_view(view.camera, view.frame, view.time_us, view.image)
        dense = np.arange(3) * 1_000, np.zeros((3, 3, 3)), np.ones((3, 3))
        writer.set_body(
            body.model,
            body.times_us,
            body.poses,
            body.transl,
            rig=body.rig,
            dense=dense,
            source="estimated",
            pose_std_rad=np.arange(36).reshape(12, 3) / 64,
            transl_std_m=np.arange(36).reshape(12, 3) / 512,
        )
        count = writer.set_events(
            (events.between(a, b) for a, b in zip(edges, edges[1:], strict=False)),
            events.width,
            events.height,
            contrast_threshold=before.contrast_threshold,
            simulated=True,
            clock_offset_us=-250,
        )
        writer.set_points(points, colours)
        writer.provenance["text"] = "made by the tests"
        assert not (tmp_path / "again").exists()
    assert [finding for finding in validate_capture(tmp_path / "again")] == []
    after = load_capture(tmp_path / "again")
    assert after.name == before.name and after.provenance == {"text": "made by the tests"}
    assert count == len(events)
    for frame, old in zip(after.frames, before.frames, strict=True):
        assert (frame.name, frame.split) == (old.name, old.split)
        assert frame.exposure_us == old.exposure_us
        assert frame.image.read_bytes() == old.image.read_bytes()
        assert np.array_equal(after.sharp(frame), before.sharp(old))
        assert np.array_equal(after.mask(frame), before.mask(old))
    assert after.camera("0003").world_to_camera[0, 3] == 0.5
    assert after.camera("0004") is after.cameras["main"]
    for name, camera in before.cameras.items():
        assert np.array_equal(after.cameras[name].K, camera.K)
        assert np.array_equal(after.cameras[name].world_to_camera, camera.world_to_camera)
    for view, old_view in zip(after.novel_views, before.novel_views, strict=True):
        assert view.time_us == old_view.time_us and view.frame == old_view.frame
        assert np.array_equal(after.novel_image(view), before.novel_image(old_view))
    for name in ("times_us", "poses", "transl", *(body.rig or {})):
        assert np.array_equal(getattr(after.body_file, name), getattr(body, name))
    errors = load_body_track(after).errors
    assert errors is not None and errors.source == "estimated" and not errors.typical
    assert np.array_equal(errors.joint_rad, np.arange(36).reshape(12, 3) / 64)
    assert np.array_equal(errors.root_m, np.arange(36).reshape(12, 3) / 512)
    unchanged = load_body_track(before).errors
    assert unchanged is not None and unchanged.source == "exact"
    assert after.dense_body_file is not None and after.dense_body_file.transl.min() == 1
    assert after.dense_body_file.errors is None
    assert after.events is not None
    all_events, old_events = after.events.between(-250, last), events.between(first, last)
    assert np.array_equal(all_events.t + 250, old_events.t)
    for name in "xyp":
        assert np.array_equal(getattr(all_events, name), getattr(old_events, name))
    read = after.initial_points()
    assert read is not None
    assert np.allclose(read[0], points, atol=1e-6) and np.allclose(read[1], colours, atol=1e-6)


@pytest.mark.parametrize("kind", ["grey8", "grey16", "rgb8", "rgb16"])
def test_stored_pixels_are_those_given(tmp_path: Path, kind: str) -> None:
    limit = 65_536 if "16" in kind else 256
    shape = (HEIGHT, WIDTH, 3) if "rgb" in kind else (HEIGHT, WIDTH)
    pixels = np.random.default_rng(1).integers(0, limit, shape)
    pixels = pixels.astype(np.uint16 if "16" in kind else np.uint8)
    with CaptureWriter(tmp_path / "one") as writer:
        writer.add_camera("main", WIDTH, HEIGHT, K)
        writer.add_frame("a", "main", pixels, (0, 30_000), mask=np.ones((HEIGHT, WIDTH), bool))
        add_body(writer, 1)
    stored = cv2.imread(str(tmp_path / "one" / "images" / "a.png"), cv2.IMREAD_UNCHANGED)
    assert stored.dtype == pixels.dtype
    assert np.array_equal(stored if stored.ndim == 2 else stored[..., ::-1], pixels)
    assert cv2.imread(str(tmp_path / "one" / "masks" / "a.png"), 0).min() == 255


def test_default_split_is_written(tmp_path: Path) -> None:
    write_small(tmp_path / "one", frames=20)
    capture = load_capture(tmp_path / "one")
    assert [frame.index for frame in capture.test_frames] == [7, 8, 9, 17, 18, 19]


def test_lens_distortion_is_kept(tmp_path: Path) -> None:
    with CaptureWriter(tmp_path / "one") as writer:
        writer.add_camera("main", WIDTH, HEIGHT, K, distortion=(-0.1, 0.02, 0.0, 0.001, 0.0))
        writer.add_camera("plain", WIDTH, HEIGHT, K, distortion=(0, 0, 0, 0, 0))
        writer.add_frame("a", "main", np.eye(HEIGHT, WIDTH), (0, 30_000))
        add_body(writer, 1)
    image = load_capture(tmp_path / "one").image("a").numpy()[..., 0]
    expected = cv2.undistort(
        np.eye(HEIGHT, WIDTH, dtype=np.float32),
        np.array(K) - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]],  # OpenCV: centre of a pixel at 0
        np.array([-0.1, 0.02, 0.0, 0.001, 0.0]),
    )
    assert np.abs(image - expected)[2:-2, 2:-2].max() < 0.06


@pytest.mark.parametrize("stop", [KeyboardInterrupt, ValueError])
def test_nothing_is_left_of_an_interrupted_capture(tmp_path: Path, stop: type) -> None:
    with pytest.raises(stop), CaptureWriter(tmp_path / "one") as writer:
        writer.add_camera("main", WIDTH, HEIGHT, K)
        writer.add_frame("a", "main", np.zeros((HEIGHT, WIDTH)), (0, 30_000))
        raise stop
    assert list(tmp_path.iterdir()) == []


def test_a_failing_event_source_leaves_nothing(tmp_path: Path) -> None:
    def pieces():
        yield EventStream(np.int64([5]), np.uint16([1]), np.uint16([1]), np.int8([1]))
        yield EventStream(np.int64([4]), np.uint16([1]), np.uint16([1]), np.int8([1]))

    with pytest.raises(DataError, match="sorted by t"), CaptureWriter(tmp_path / "one") as writer:
        writer.set_events(pieces(), WIDTH, HEIGHT, contrast_threshold=None, simulated=True)
    assert list(tmp_path.iterdir()) == []


def test_an_existing_folder_is_only_replaced_when_asked_and_a_capture(tmp_path: Path) -> None:
    write_small(tmp_path / "one", frames=11)
    with pytest.raises(DataError, match="one: already exists"):
        CaptureWriter(tmp_path / "one")
    write_small(tmp_path / "one", frames=12, overwrite=True)
    assert len(load_capture(tmp_path / "one").frames) == 12
    with pytest.raises(ValueError), CaptureWriter(tmp_path / "one", overwrite=True):
        raise ValueError
    assert len(load_capture(tmp_path / "one").frames) == 12
    (tmp_path / "letters").mkdir()
    (tmp_path / "letters" / "dear.txt").write_text("…")
    with pytest.raises(DataError, match="letters: exists and is not a capture"):
        CaptureWriter(tmp_path / "letters", overwrite=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["letters", "one"]


def test_an_invalid_capture_is_refused_under_its_own_name(tmp_path: Path) -> None:
    with pytest.raises(DataError) as caught, CaptureWriter(tmp_path / "one") as writer:
        writer.add_camera("main", WIDTH, HEIGHT, K, 2 * np.eye(4))
        writer.add_frame("a", "main", np.zeros((HEIGHT, WIDTH)), (0, 30_000))
        add_body(writer, 1)
    message = str(caught.value)
    assert message.startswith(f"{tmp_path / 'one' / 'capture.json'}: cameras.main.world_to_camera")
    assert list(tmp_path.iterdir()) == []


def tif_picture(writer: CaptureWriter) -> Path:
    path = writer.path.parent / "one.tif"
    cv2.imwrite(str(path), np.zeros((HEIGHT, WIDTH), np.uint8))
    return path


BAD_CALLS = {
    "no body": (lambda writer: None, "given no body"),
    "unknown camera": (
        lambda writer: writer.add_frame("a", "side", np.zeros((2, 2)), (0, 1)),
        r"images/a is of camera 'side', expected one of \['main'\]",
    ),
    "size": (
        lambda writer: writer.add_frame("a", "main", np.zeros((HEIGHT, 5)), (0, 1)),
        f"images/a: has 5x{HEIGHT} pixels, expected {WIDTH}x{HEIGHT} of camera 'main'",
    ),
    "range": (
        lambda writer: writer.add_frame("a", "main", np.full((HEIGHT, WIDTH), 7.0), (0, 1)),
        r"images/a: has values in \[7, 7\], expected \[0, 1\]",
    ),
    "channels": (
        lambda writer: writer.add_frame("a", "main", np.zeros((HEIGHT, WIDTH, 4)), (0, 1)),
        r"expected \(H, W\) or \(H, W, 3\)",
    ),
    "frame name": (
        lambda writer: writer.add_frame("../a", "main", np.zeros((HEIGHT, WIDTH)), (0, 1)),
        r"'../a' is no name for a frame",
    ),
    "camera name": (lambda writer: writer.add_camera("a/b", 1, 1, K), "no name for a camera"),
    "long name": (
        lambda writer: writer.add_frame("a" * 201, "main", np.zeros((HEIGHT, WIDTH)), (0, 1)),
        "is no name for a frame, expected 1 to 200 bytes",
    ),
    "picture format": (
        lambda writer: writer.add_frame("a", "main", tif_picture(writer), (0, 1)),
        "one.tif: expected a PNG, JPEG or WebP picture",
    ),
}


@pytest.mark.parametrize("fault", BAD_CALLS)
def test_what_does_not_fit_is_named(tmp_path: Path, fault: str) -> None:
    call, message = BAD_CALLS[fault]
    with pytest.raises(DataError, match=message), CaptureWriter(tmp_path / "one") as writer:
        writer.add_camera("main", WIDTH, HEIGHT, K)
        call(writer)
    assert list(tmp_path.glob(".*")) == [] and not (tmp_path / "one").exists()


def test_a_folder_whose_name_is_none_for_a_capture_is_refused_at_once(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="is no name for a capture"):
        CaptureWriter(tmp_path / "a\\b")
    with pytest.raises(DataError, match="is no name for a capture"):
        CaptureWriter(tmp_path / "one", "../../one")
    write_small(tmp_path / "a\\b", name="a b")
    assert load_capture(tmp_path / "a\\b").name == "a b"


def test_names_may_have_spaces_and_letters_of_any_script(tmp_path: Path) -> None:
    with CaptureWriter(tmp_path / "one") as writer:
        writer.add_camera("Kamera 1", WIDTH, HEIGHT, K)
        writer.add_frame("Bild ä", "Kamera 1", np.zeros((HEIGHT, WIDTH)), (0, 30_000))
        add_body(writer, 1)
    assert load_capture(tmp_path / "one").frames[0].name == "Bild ä"
