"""Loading captures: what comes out, and that nothing is read before it is asked for."""

import json
import pickle
import sys
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
import torch
from PIL import Image

from evsplat.capture import Capture, load_capture
from evsplat.capture.distortion import Distortion
from evsplat.errors import DataError
from evsplat.events import count_map
from evsplat.pictures.files import ImageCache, write_image

from .editing import edit

Factory = Callable[..., Path]
FILES_READ: list[str] | None = None


def _note_opened(event: str, arguments: tuple) -> None:
    if FILES_READ is not None and event == "open":
        FILES_READ.append(str(arguments[0]))


sys.addaudithook(_note_opened)


@pytest.fixture
def files_read() -> list[str]:
    """Every path that Python opens during the test (audit hooks cannot be removed again)."""
    global FILES_READ
    FILES_READ = []
    yield FILES_READ
    FILES_READ = None


def test_everything_written_comes_back(tiny_capture: Factory) -> None:
    path = tiny_capture(frames=12)
    document = json.loads((path / "capture.json").read_text())
    capture = load_capture(path)
    assert capture.name == "tiny" and capture.is_static_camera
    assert [frame.name for frame in capture.frames] == [f"{i:04d}" for i in range(12)]
    assert [frame.index for frame in capture.test_frames] == [7, 8, 9]
    assert len(capture.train_frames) == 9
    assert capture.contrast_threshold == (0.2, 0.2) and capture.events_simulated
    assert capture.provenance == document["provenance"]
    for frame, entry in zip(capture.frames, document["frames"], strict=True):
        assert capture.frame(frame.name) is frame
        assert list(frame.exposure_us) == entry["exposure_us"]
        assert frame.mid_us == entry["exposure_us"][0] + 15_000
        for key, read in (("image", capture.image), ("sharp", capture.sharp)):
            stored = np.asarray(Image.open(path / entry[key]))
            assert np.array_equal((read(frame) * 255).round().byte().numpy(), stored)
        stored_mask = np.asarray(Image.open(path / entry["mask"]))
        mask = capture.mask(frame)
        assert mask is not None and np.array_equal((mask * 255).round().byte().numpy(), stored_mask)
    camera = capture.camera("0003")
    assert (camera.width, camera.height) == (32, 24)
    assert np.allclose(camera.K, document["cameras"]["main"]["K"])
    view = capture.novel_views[1]
    assert (view.frame, view.camera) == ("0008", "side")
    stored = np.asarray(Image.open(view.image))
    assert np.array_equal((capture.novel_image(view) * 255).round().byte().numpy(), stored)
    body = capture.body_file
    with np.load(path / "body.npz") as arrays:
        assert body.model == "rig" and body.joint_names == ("Hips", "Chest", "Arm")
        for key in ("times_us", "poses", "transl", "parents", "rest_joints", "weights", "faces"):
            assert np.array_equal(getattr(body, key), arrays[key])
    assert capture.dense_body_file is None and capture.initial_points() is None


def test_blur_of_the_tiny_capture_lies_between_its_sharp_frames_events(
    tiny_capture: Factory,
) -> None:
    """The fixture itself: summed events explain the log change between sharp frames."""
    capture = load_capture(tiny_capture())
    assert capture.events is not None
    luma = torch.tensor([0.2126, 0.7152, 0.0722])
    logs = [torch.log(capture.sharp(f) ** 2.2 @ luma + 1e-3) for f in capture.frames[:2]]
    window = capture.events.between(capture.frames[0].mid_us, capture.frames[1].mid_us)
    counted = 0.2 * count_map(window, 24, 32)
    change = logs[1] - logs[0]
    assert (counted - change).abs().mean() < 0.5 * change.abs().mean()


def test_default_split_is_three_of_ten(tiny_capture: Factory) -> None:
    path = tiny_capture(frames=20)
    edit(path, lambda document: [frame.pop("split") for frame in document["frames"]])
    capture = load_capture(path)
    assert [frame.index for frame in capture.test_frames] == [7, 8, 9, 17, 18, 19]


def test_nothing_but_sharp_opens_the_sharp_pictures(
    tiny_capture: Factory, files_read: list[str]
) -> None:
    path = tiny_capture()
    files_read.clear()
    capture = load_capture(path)
    for frame in capture.frames:
        capture.image(frame)
        capture.mask(frame)
        capture.camera(frame)
    for view in capture.novel_views:
        capture.novel_image(view)
    capture.median_background()
    assert capture.events is not None and len(capture.events.between(0, 100_000)) > 0
    assert capture.body_file.model == "rig"
    assert any("/images/" in name for name in files_read)
    assert not any("/sharp/" in name for name in files_read)
    capture.sharp("0003")
    assert [name for name in files_read if "/sharp/" in name] == [str(path / "sharp/0003.png")]


def test_pictures_are_decoded_on_demand_and_cached(
    tiny_capture: Factory, files_read: list[str]
) -> None:
    path = tiny_capture()
    capture = load_capture(path)
    files_read.clear()
    first = capture.image("0004")
    assert files_read == [str(path / "images/0004.png")]
    files_read.clear()
    again = capture.image("0004")
    assert files_read == [] and torch.equal(first, again)
    again.zero_()  # a caller that writes to what it got must not spoil the cache
    assert torch.equal(capture.image("0004"), first)


def test_cache_never_exceeds_its_limit() -> None:
    cache = ImageCache(1_000)
    made = []
    for key in (1, 2, 3, 1, 4, 2, 1):
        cache.get(key, lambda key=key: made.append(key) or np.zeros(300, dtype=np.uint8))
        assert cache.bytes <= 1_000
    # 1 2 3 are kept; 4 drops 2 (1 was used later); 2 drops 3
    assert made == [1, 2, 3, 4, 2]
    big = cache.get("big", lambda: np.zeros(5_000, dtype=np.uint8))
    assert len(big) == 5_000 and cache.bytes <= 1_000


def test_opening_a_long_recording_reads_no_events(tiny_capture: Factory) -> None:
    path = tiny_capture()
    with h5py.File(path / "events.h5", "r+") as file:
        del file["events"], file["ms_to_idx"]
        count = 2_000_000
        t = np.linspace(0, 400_000, count).astype(np.int64)
        zeros = np.zeros(count, dtype=np.uint16)
        for key, values in (("t", t), ("x", zeros), ("y", zeros), ("p", zeros.astype(np.uint8))):
            file.create_dataset(f"events/{key}", data=values, chunks=(65_536,))
        file["ms_to_idx"] = np.searchsorted(t, np.arange(401) * 1000).astype(np.uint64)
    load_capture(path)
    tracemalloc.start()
    capture = load_capture(path)
    assert capture.events is not None and len(capture.events) == count
    assert len(capture.events.between(200_000, 201_000)) == pytest.approx(5_000, abs=1)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 4_000_000  # the events are 26 MB


@pytest.mark.parametrize("kind", ["grey8", "grey16", "rgb16", "rgba8"])
def test_all_kinds_of_pictures_are_read(tiny_capture: Factory, kind: str) -> None:
    path = tiny_capture()
    rng = np.random.default_rng(0)
    limit = 65_535 if "16" in kind else 255
    channels = {"grey": 1, "rgba": 4}.get(kind.rstrip("168"), 3)
    pixels = rng.integers(0, limit + 1, (24, 32, channels))
    pixels = pixels.astype(np.uint16 if "16" in kind else np.uint8)
    stored = pixels[..., [2, 1, 0, 3][:channels]] if channels > 1 else pixels
    assert cv2.imwrite(str(path / "images/0002.png"), stored)
    image = load_capture(path).image("0002")
    expected = pixels[..., :3].astype(np.float64) / limit
    assert image.shape == (24, 32, 3) and image.dtype == torch.float32
    assert np.allclose(image.numpy(), np.broadcast_to(expected, (24, 32, 3)), atol=1e-6)


def test_moving_camera_overrides_the_pose_of_its_frame(tiny_capture: Factory) -> None:
    path = tiny_capture()
    moved = np.eye(4)
    moved[:3, 3] = 1, 2, 3

    def change(document: dict) -> None:
        document["frames"][4]["world_to_camera"] = moved.tolist()

    edit(path, change)
    capture = load_capture(path)
    assert not capture.is_static_camera
    assert np.array_equal(capture.camera("0004").world_to_camera.numpy(), moved)
    assert capture.camera("0005") is capture.cameras["main"]
    with pytest.raises(DataError, match="camera that stands still"):
        capture.median_background()


def repeated(path: Path, pose: np.ndarray, *, given: slice = slice(None)) -> Capture:
    """The capture with one pose in the entries of its frames."""

    def change(document: dict) -> None:
        for frame in document["frames"][given]:
            frame["world_to_camera"] = pose.tolist()

    edit(path, change)
    return load_capture(path)


def test_a_pose_that_every_frame_repeats_is_that_of_a_camera_at_rest(tiny_capture: Factory) -> None:
    pose = np.eye(4)
    pose[:3, 3] = 0.25, 0.5, 3.0
    capture = repeated(tiny_capture(), pose)
    assert capture.is_static_camera
    assert np.array_equal(capture.cameras["main"].world_to_camera.numpy(), pose)
    assert all(capture.camera(frame) is capture.cameras["main"] for frame in capture.frames)
    capture.median_background()


def test_a_pose_of_some_frames_is_that_of_all_only_where_the_camera_has_it(
    tiny_capture: Factory,
) -> None:
    own = load_capture(tiny_capture()).cameras["main"].world_to_camera.numpy().astype(float)
    assert repeated(tiny_capture("same"), own, given=slice(3)).is_static_camera
    other = own.copy()
    other[0, 3] += 1e-3
    assert not repeated(tiny_capture("other"), other, given=slice(3)).is_static_camera


def test_a_camera_of_novel_views_keeps_its_own_pose(tiny_capture: Factory) -> None:
    path = tiny_capture()
    own = load_capture(path).cameras["main"].world_to_camera.numpy().astype(float)

    def add_view(document: dict) -> None:
        frame = document["frames"][2]
        middle = sum(frame["exposure_us"]) // 2
        view = {"camera": "main", "frame": frame["name"], "time_us": middle}
        document["novel_views"] = [view | {"image": frame["image"]}]

    edit(path, add_view)
    moved = own.copy()
    moved[0, 3] += 0.5
    capture = repeated(path, moved)
    assert len(capture.novel_views) == 1
    assert not capture.is_static_camera
    assert np.allclose(capture.cameras["main"].world_to_camera.numpy(), own)


def test_median_background_is_the_median_of_the_train_frames(tiny_capture: Factory) -> None:
    capture = load_capture(tiny_capture(seed=3))
    stack = torch.stack([capture.image(frame) for frame in capture.train_frames])
    expected = np.median(stack.numpy(), axis=0)
    assert np.allclose(capture.median_background().numpy(), expected, atol=1e-6)


def test_pictures_of_several_kinds_have_a_median(
    tiny_capture: Factory, rng: np.random.Generator
) -> None:
    """8 and 16 bits, grey and colour, as of a folder of pictures that two programs wrote."""
    path = tiny_capture()
    for frame in load_capture(path).train_frames:
        kind = rng.choice([np.uint8, np.uint16])
        picture = rng.uniform(0, 1, (24, 32, 3) if rng.random() < 0.5 else (24, 32))
        write_image(frame.image, np.round(picture * np.iinfo(kind).max).astype(kind))
    capture = load_capture(path)
    stack = np.stack([capture.image(frame).numpy() for frame in capture.train_frames])
    assert np.allclose(capture.median_background().numpy(), np.median(stack, axis=0), atol=1e-6)


def test_distortion_is_removed_from_pictures_masks_and_events(tiny_capture: Factory) -> None:
    path = tiny_capture()
    straight = load_capture(path)
    coefficients = [-0.2, 0.05, 0.001, 0.0]

    def change(document: dict) -> None:
        lens = {"model": "opencv", "coefficients": coefficients}
        document["cameras"]["main"]["distortion"] = lens

    edit(path, change)
    capture = load_capture(path)
    K = straight.cameras["main"].K.double().numpy()
    lens = Distortion(32, 24, K, tuple(coefficients))
    expected = lens.undistort_image(straight.image("0003").numpy())
    assert np.allclose(capture.image("0003").numpy(), expected, atol=1e-5)
    mask, straight_mask = capture.mask("0003"), straight.mask("0003")
    assert mask is not None and straight_mask is not None
    assert np.allclose(mask.numpy(), lens.undistort_image(straight_mask.numpy()), atol=1e-5)
    assert np.array_equal(capture.camera("0003").K, straight.camera("0003").K)
    assert capture.events is not None and straight.events is not None
    seen = capture.events.between(0, 400_000)
    raw = straight.events.between(0, 400_000)
    centres = np.stack([raw.x + 0.5, raw.y + 0.5], axis=-1)
    place = np.floor(lens.undistort(centres))
    inside = ((place >= 0) & (place < (32, 24))).all(-1)
    assert np.array_equal(np.stack([seen.x, seen.y], axis=-1), place[inside])
    assert np.array_equal(seen.t, raw.t[inside])
    # the background keeps its straight median
    assert np.isfinite(capture.median_background().numpy()).all()


@pytest.mark.parametrize("layout", ["ascii", "binary_little_endian"])
def test_initial_points_are_read(tiny_capture: Factory, layout: str) -> None:
    path = tiny_capture()
    rng = np.random.default_rng(0)
    points, colours = rng.normal(size=(7, 3)).astype(np.float32), rng.integers(0, 256, (7, 3))
    header = f"ply\nformat {layout} 1.0\nelement vertex 7\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz")
    header += "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
    rows = np.zeros(7, dtype=[("p", "<f4", 3), ("c", "u1", 3)])
    rows["p"], rows["c"] = points, colours
    lines = [" ".join(map(repr, [*map(float, p), *map(int, c)])) for p, c in rows]
    body = rows.tobytes() if layout != "ascii" else ("\n".join(lines) + "\n").encode()
    (path / "points.ply").write_bytes(header.encode() + b"end_header\n" + body)
    loaded = load_capture(path).initial_points()
    assert loaded is not None
    assert np.allclose(loaded[0].numpy(), points) and np.allclose(loaded[1] * 255, colours)
    (path / "points.ply").write_bytes(header.encode() + b"end_header\n" + body[: len(body) // 2])
    with pytest.raises(DataError, match="points.ply"):
        load_capture(path).initial_points()


def test_capture_survives_pickling(tiny_capture: Factory) -> None:
    capture = load_capture(tiny_capture())
    assert capture.events is not None
    before = capture.events.between(0, 50_000)
    copy = pickle.loads(pickle.dumps(capture))
    assert torch.equal(copy.image("0001"), capture.image("0001"))
    assert np.array_equal(copy.events.between(0, 50_000).t, before.t)


def test_unknown_frame_and_missing_truth_are_data_errors(tiny_capture: Factory) -> None:
    path = tiny_capture()
    edit(path, lambda document: document["frames"][2].pop("sharp"))
    capture = load_capture(path)
    with pytest.raises(DataError, match="'0002' names no sharp picture"):
        capture.sharp("0002")
    with pytest.raises(DataError, match="no frame is named '9999'"):
        capture.image("9999")


def test_picture_exchanged_after_loading_is_refused(tiny_capture: Factory) -> None:
    path = tiny_capture()
    capture = load_capture(path)
    Image.new("RGB", (16, 24)).save(path / "images/0003.png")
    with pytest.raises(DataError, match="16x24 pixels, expected 32x24"):
        capture.image("0003")
