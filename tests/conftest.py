"""Captures that tests share: those on disk, the one that ships, and a tiny one made on the fly."""

import functools
import importlib
import json
import os
import shutil
import signal
import tempfile
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import h5py
import hypothesis
import numpy as np
import pytest
import torch
from PIL import Image, ImageDraw
from scipy.spatial.transform import Rotation

# Workers beside each other share the cores; processes that tests start take the same number.
if workers := int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "0")):
    threads = max(1, (os.cpu_count() or 1) // workers)
    os.environ.setdefault("OMP_NUM_THREADS", str(threads))
    torch.set_num_threads(threads)
# Ignored where a shell put the tests into the background, and then in all that they start.
signal.signal(signal.SIGINT, signal.default_int_handler)
# A busy machine is no failure.
hypothesis.settings.register_profile("evsplat", deadline=None)
hypothesis.settings.load_profile("evsplat")

REPOSITORY = Path(__file__).resolve().parents[1]
CONTRAST = 0.2
PERIOD_US, EXPOSURE_US, SUBFRAMES = 40_000, 30_000, 8


def pytest_sessionstart(session: pytest.Session) -> None:
    """Workers import different test modules first, so that each is made ready once, for all.

    pytest rewrites a module's assertions on its first import, which takes longer than most tests,
    and keeps what comes of it. Workers that all collect from the start would rewrite all modules.
    """
    folder, worker = REPOSITORY / "tests", int(os.environ.get("PYTEST_XDIST_WORKER", "gw0")[2:])
    if worker == 0 or [Path(asked).resolve() for asked in session.config.args] != [folder]:
        return
    paths = sorted(folder.rglob("test_*.py"))
    for path in paths[len(paths) * worker // workers : len(paths) * (worker + 1) // workers]:
        # One that is skipped or broken is told when it is collected.
        with suppress(Exception, pytest.skip.Exception):
            importlib.import_module(".".join(path.relative_to(REPOSITORY).with_suffix("").parts))


@pytest.fixture
def little_memory() -> Iterator[None]:
    """At most a megabyte is taken in the test."""
    tracemalloc.start()
    yield
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1 << 20


@pytest.fixture(scope="session")
def captures_root() -> Path:
    """Folder of the shared captures; tests that need it are skipped where it is absent."""
    for data in (os.environ.get("EVSPLAT_TEST_DATA"), REPOSITORY.parent / "shared" / "data"):
        if data and (Path(data) / "captures").is_dir():
            return Path(data) / "captures"
    pytest.skip(
        "needs the shared captures: set EVSPLAT_TEST_DATA to the folder that holds captures/"
    )


@pytest.fixture(scope="session")
def recordings_root() -> Path:
    """Folder of the shared event recordings; tests that need it are skipped where it is absent."""
    for data in (os.environ.get("EVSPLAT_TEST_DATA"), REPOSITORY.parent / "shared" / "data"):
        if data and (Path(data) / "events").is_dir():
            return Path(data) / "events"
    pytest.skip("needs the shared recordings: set EVSPLAT_TEST_DATA to the folder with events/")


@pytest.fixture(scope="session")
def demo_capture_path() -> Path:
    """The capture that ships with the package."""
    return REPOSITORY / "src" / "evsplat" / "data" / "demo_capture"


@pytest.fixture
def tiny_capture(tmp_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Factory of small valid captures: a two-box person before a static background.

    Options are those of `write_tiny_capture`; each call gives a copy that the test may spoil.
    """

    def make(name: str = "tiny", **options: int) -> Path:
        key = "-".join(f"{option}{value}" for option, value in sorted(options.items()))
        original = tmp_path_factory.getbasetemp() / f"original-{key}" / "tiny"
        if not original.exists():
            write_tiny_capture(original, **options)
        return Path(shutil.copytree(original, tmp_path / name))

    return make


def write_tiny_capture(
    path: Path, *, frames: int = 10, width: int = 32, height: int = 24, seed: int = 0
) -> Path:
    """Write a valid capture with truth, masks, a novel view and events that fit the pictures."""
    for name, content in _tiny_files(frames, width, height, seed).items():
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        (path / name).write_bytes(content)
    document = json.loads((path / "capture.json").read_text())
    (path / "capture.json").write_text(json.dumps(document | {"name": path.name}))
    return path


@functools.lru_cache(maxsize=16)  # tests ask for few kinds, hundreds of times
def _tiny_files(frames: int, width: int, height: int, seed: int) -> dict[str, bytes]:
    with tempfile.TemporaryDirectory() as folder:
        _draw_tiny_capture(Path(folder), frames, width, height, seed)
        files = (file for file in Path(folder).rglob("*") if file.is_file())
        return {file.relative_to(folder).as_posix(): file.read_bytes() for file in files}


def _draw_tiny_capture(path: Path, frames: int, width: int, height: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    for folder in ("images", "sharp", "masks", "novel/side"):
        (path / folder).mkdir(parents=True)
    rig = _rig()
    cameras = {"main": _camera(width, height, 0.0), "side": _camera(width, height, 0.7)}
    background = _background(rng, width, height)
    phase = rng.uniform(0, 2 * np.pi)
    entries, views, sequence, times = [], [], [], []
    for index in range(frames):
        frame_name, start = f"{index:04d}", index * PERIOD_US
        subframe_times = start + (np.arange(SUBFRAMES) + 0.5) * EXPOSURE_US / SUBFRAMES
        linear = [
            _draw(rig, cameras["main"], background, t, phase)[0] ** 2.2 for t in subframe_times
        ]
        sequence += linear
        times += subframe_times.tolist()
        middle = start + EXPOSURE_US // 2
        sharp, mask = _draw(rig, cameras["main"], background, middle, phase)
        _save(path / f"images/{frame_name}.png", np.mean(linear, axis=0) ** (1 / 2.2))
        _save(path / f"sharp/{frame_name}.png", sharp)
        _save(path / f"masks/{frame_name}.png", mask)
        split = "test" if index % 10 >= 7 else "train"
        entry = {"name": frame_name, "camera": "main", "image": f"images/{frame_name}.png"}
        entry |= {"exposure_us": [start, start + EXPOSURE_US], "split": split}
        entries.append(
            entry | {"sharp": f"sharp/{frame_name}.png", "mask": f"masks/{frame_name}.png"}
        )
        if split == "test":
            image = f"novel/side/{frame_name}.png"
            _save(path / image, _draw(rig, cameras["side"], background, middle, phase)[0])
            views.append({"camera": "side", "frame": frame_name, "time_us": middle, "image": image})
    write_event_file(path / "events.h5", *_simulate_events(np.array(sequence), np.array(times)))
    key_times = np.arange(frames) * PERIOD_US + EXPOSURE_US // 2
    poses, transl = zip(*(_pose(t, phase) for t in key_times), strict=True)
    arrays = {"times_us": key_times, "poses": np.float32(poses), "transl": np.float32(transl)}
    np.savez_compressed(path / "body.npz", model="rig", **arrays, **rig)
    document = {
        "format": "evsplat-capture",
        "version": 1,
        "name": "tiny",
        "cameras": cameras,
        "frames": entries,
        "novel_views": views,
        "body": {"file": "body.npz", "model": "rig", "source": "exact"},
        "events": {
            "file": "events.h5",
            "width": width,
            "height": height,
            "contrast_threshold": [CONTRAST, CONTRAST],
            "simulated": True,
        },
        "provenance": {"text": "made by the tests", "gamma": 2.2},
    }
    (path / "capture.json").write_text(json.dumps(document))


def write_event_file(
    path: Path, t: np.ndarray, x: np.ndarray, y: np.ndarray, p: np.ndarray
) -> None:
    """Events as they are (sorted or not) in the layout of format version 1, with p in {0, 1}."""
    with h5py.File(path, "w") as file:
        for key, values, dtype in (("t", t, "i8"), ("x", x, "u2"), ("y", y, "u2"), ("p", p, "u1")):
            file.create_dataset(
                f"events/{key}", data=values.astype(dtype), chunks=True, compression="gzip"
            )
        last_ms = int(t.max()) // 1000 if len(t) else 0
        file["ms_to_idx"] = np.array(
            [(t < 1000 * ms).sum() for ms in range(last_ms + 2)], dtype=np.uint64
        )
        file["t_offset"] = np.int64(0)


def _background(rng: np.random.Generator, width: int, height: int) -> np.ndarray:
    """Soft colours without detail, (H, W, 3) in [0.2, 0.7]."""
    coarse = Image.fromarray((255 * rng.random((3, 4, 3))).astype(np.uint8))
    fine = coarse.resize((width, height), Image.Resampling.BICUBIC)
    return 0.2 + 0.5 * np.asarray(fine, dtype=np.float32) / 255


def _rig() -> dict[str, np.ndarray]:
    """A torso and an arm: two boxes on three joints, rigidly weighted."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / 2
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    torso = corners * (0.45, 0.25, 1.1) + (0, 0, 1.0)
    arm = corners * (0.7, 0.18, 0.18) + (0.6, 0, 1.4)
    weights = np.zeros((16, 3), dtype=np.float32)
    weights[:8, 0], weights[8:, 2] = 1, 1
    return {
        "joint_names": np.array(["Hips", "Chest", "Arm"]),
        "parents": np.array([-1, 0, 1], dtype=np.int32),
        "rest_joints": np.float32([[0, 0, 0.9], [0, 0, 1.3], [0.25, 0, 1.4]]),
        "rest_vertices": np.concatenate([torso, arm]).astype(np.float32),
        "faces": np.concatenate([triangles, triangles + 8]).astype(np.int32),
        "weights": weights,
    }


def _pose(time_us: float, phase: float) -> tuple[np.ndarray, np.ndarray]:
    """Axis-angle (3, 3) and root shift: the body sways, the arm swings about the y axis."""
    angle = time_us * 1e-6 * 2 * np.pi / 0.5 + phase
    poses = np.zeros((3, 3))
    poses[0, 2], poses[2, 1] = 0.3 * np.sin(angle / 2), 0.9 * np.sin(angle)
    return poses, np.array([0.15 * np.cos(angle / 2), 0.0, 0.0])


def _posed_vertices(rig: dict[str, np.ndarray], time_us: float, phase: float) -> np.ndarray:
    """Linear blend skinning, written out."""
    poses, transl = _pose(time_us, phase)
    rotations, origins = [], []
    for joint, parent in enumerate(rig["parents"]):
        local = Rotation.from_rotvec(poses[joint]).as_matrix()
        if parent < 0:
            rotations.append(local)
            origins.append(rig["rest_joints"][joint] + transl)
        else:
            bone = rig["rest_joints"][joint] - rig["rest_joints"][parent]
            rotations.append(rotations[parent] @ local)
            origins.append(origins[parent] + rotations[parent] @ bone)
    posed = [
        (rig["rest_vertices"] - rig["rest_joints"][j]) @ rotations[j].T + origins[j]
        for j in range(len(origins))
    ]
    return np.einsum("vj,jvc->vc", rig["weights"], np.array(posed))


def _camera(width: int, height: int, angle: float) -> dict:
    """A camera three metres away that looks at the person from ``angle`` radians to the side."""
    focal = 1.7 * height
    rotation = np.array(
        [[np.cos(angle), np.sin(angle), 0], [0, 0, -1], [-np.sin(angle), np.cos(angle), 0]]
    )
    translation = -rotation @ (np.array([0, 0, 1.0]) - 3 * rotation[2])
    return {
        "width": width,
        "height": height,
        "K": [[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]],
        "world_to_camera": [
            *np.column_stack([rotation, translation]).tolist(),
            [0, 0, 0, 1],
        ],
        "distortion": None,
    }


def _draw(
    rig: dict[str, np.ndarray], camera: dict, background: np.ndarray, time_us: float, phase: float
) -> tuple[np.ndarray, np.ndarray]:
    """sRGB picture and person mask, both in [0, 1], four times oversampled."""
    scale = 4
    pose = np.array(camera["world_to_camera"])
    seen = _posed_vertices(rig, time_us, phase) @ pose[:3, :3].T + pose[:3, 3]
    pixels = scale * (seen @ np.array(camera["K"]).T)[:, :2] / seen[:, 2:]
    size = (scale * camera["width"], scale * camera["height"])
    cover = []
    for part in (rig["faces"][:12], rig["faces"][12:]):
        mask = Image.new("L", size)
        draw = ImageDraw.Draw(mask)
        for triangle in part:
            draw.polygon([tuple(pixels[v]) for v in triangle], fill=255)
        small = mask.resize((camera["width"], camera["height"]), Image.Resampling.BOX)
        cover.append(np.asarray(small, dtype=np.float32) / 255)
    picture = background
    for alpha, colour in zip(cover, ([0.9, 0.3, 0.2], [0.2, 0.3, 0.95]), strict=True):
        picture = picture * (1 - alpha[..., None]) + alpha[..., None] * np.float32(colour)
    return picture, np.maximum(*cover)


def _simulate_events(linear: np.ndarray, times: np.ndarray) -> tuple[np.ndarray, ...]:
    """Noise-free events of (T, H, W, 3) linear pictures at ``times``, sorted, p in {0, 1}."""
    log_luma = np.log(linear @ np.array([0.2126, 0.7152, 0.0722]) + 1e-3)
    level = log_luma[0].copy()
    columns: list[tuple[float, int, int, int]] = []
    for step in range(1, len(times)):
        change = log_luma[step] - level
        crossings = np.trunc(change / CONTRAST).astype(int)
        for y, x in np.argwhere(crossings != 0):
            count = abs(crossings[y, x])
            spread = times[step - 1] + (np.arange(count) + 1) / count * (
                times[step] - times[step - 1]
            )
            columns += [(t, x, y, int(crossings[y, x] > 0)) for t in spread]
        level += crossings * CONTRAST
    columns.sort(key=lambda event: event[0])
    t, x, y, p = np.array(columns).T
    return t.astype(np.int64), x.astype(int), y.astype(int), p.astype(int)


def _save(path: Path, image: np.ndarray) -> None:
    Image.fromarray((image.clip(0, 1) * 255 + 0.5).astype(np.uint8)).save(path)
