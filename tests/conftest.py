"""Captures that tests share: those on disk, the one that ships, and a tiny one made on the fly."""

import functools
import gc
import importlib
import json
import os
import signal
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import suppress
from io import BytesIO
from pathlib import Path

import h5py
import hypothesis
import numpy as np
import pytest
import torch
from PIL import Image, ImageDraw
from scipy.spatial.transform import Rotation

from evsplat.body import Body, default_body

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
# Until tests are collected hardly anything is garbage; looking for it took a sixth of that time.
gc.disable()

REPOSITORY = Path(__file__).resolve().parents[1]
CONTRAST = 0.2
PERIOD_US, EXPOSURE_US, SUBFRAMES = 40_000, 30_000, 8


def pytest_addoption(parser: pytest.Parser) -> None:
    """What a test drew that failed is drawn again."""
    parser.addoption("--seed", type=int, help="of the numbers that tests draw anew in each run")


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


def pytest_collection_finish() -> None:
    """From here on garbage is looked for as always, but not in what stays to the end."""
    gc.freeze()
    gc.enable()


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


@pytest.fixture(scope="session")
def body() -> Body:
    """The body that ships, of middling shape."""
    return default_body()


@pytest.fixture
def rng(pytestconfig: pytest.Config) -> np.random.Generator:
    """Of a seed that no two runs share; pytest shows it where a test fails."""
    seed = pytestconfig.getoption("--seed")
    if seed is None:
        seed = int(np.random.default_rng().integers(1 << 31))
    print(f"drawn by seed {seed}: pytest --seed {seed} draws the same")
    return np.random.default_rng(seed)


@pytest.fixture
def tiny_capture(tmp_path: Path) -> Callable[..., Path]:
    """Factory of small valid captures: a two-box person before a static background.

    Options are those of `write_tiny_capture`, but all are named "tiny", whatever their folder.
    """

    def make(name: str = "tiny", **options: int) -> Path:
        return write_tiny_capture(tmp_path / name, name="tiny", **options)

    return make


def write_tiny_capture(
    path: Path,
    *,
    frames: int = 10,
    width: int = 32,
    height: int = 24,
    seed: int = 0,
    name: str | None = None,
) -> Path:
    """Write a valid capture with truth, masks, a novel view and events that fit the pictures.

    It has the folder's name by default. The test may spoil it: each call writes all files anew.
    """
    files = _tiny_files(frames, width, height, seed)
    document = json.loads(files["capture.json"]) | {"name": name or path.name}
    for folder in {(path / file).parent for file in files}:
        folder.mkdir(parents=True, exist_ok=True)
    for file, content in (files | {"capture.json": json.dumps(document).encode()}).items():
        (path / file).write_bytes(content)
    return path


# Tests ask for few kinds, hundreds of times, and drawing takes fifty times as long as writing.
@functools.lru_cache(maxsize=16)
def _tiny_files(frames: int, width: int, height: int, seed: int) -> dict[str, bytes]:
    """Content of each file of the capture by its path."""
    rng = np.random.default_rng(seed)
    rig = _rig()
    cameras = {"main": _camera(width, height, 0.0), "side": _camera(width, height, 0.7)}
    background = _background(rng, width, height)
    phase = rng.uniform(0, 2 * np.pi)
    starts = np.arange(frames) * PERIOD_US
    middles = starts + EXPOSURE_US // 2
    times = starts[:, None] + (np.arange(SUBFRAMES) + 0.5) * EXPOSURE_US / SUBFRAMES
    linear = _draw(rig, cameras["main"], background, times.ravel(), phase)[0] ** 2.2
    blurry = linear.reshape(frames, SUBFRAMES, height, width, 3).mean(1) ** (1 / 2.2)
    sharp, masks = _draw(rig, cameras["main"], background, middles, phase)
    aside = _draw(rig, cameras["side"], background, middles, phase)[0]
    files: dict[str, bytes] = {}
    entries, views = [], []
    for index, (start, middle) in enumerate(zip(starts.tolist(), middles.tolist(), strict=True)):
        frame_name = f"{index:04d}"
        files[f"images/{frame_name}.png"] = _png(blurry[index])
        files[f"sharp/{frame_name}.png"] = _png(sharp[index])
        files[f"masks/{frame_name}.png"] = _png(masks[index])
        split = "test" if index % 10 >= 7 else "train"
        entry = {"name": frame_name, "camera": "main", "image": f"images/{frame_name}.png"}
        entry |= {"exposure_us": [start, start + EXPOSURE_US], "split": split}
        entries.append(
            entry | {"sharp": f"sharp/{frame_name}.png", "mask": f"masks/{frame_name}.png"}
        )
        if split == "test":
            image = f"novel/side/{frame_name}.png"
            files[image] = _png(aside[index])
            views.append({"camera": "side", "frame": frame_name, "time_us": middle, "image": image})
    write_event_file(events := BytesIO(), *_simulate_events(linear, times.ravel()))
    poses, transl = _pose(middles, phase)
    arrays = {"times_us": middles, "poses": np.float32(poses), "transl": np.float32(transl)}
    np.savez_compressed(body := BytesIO(), model="rig", **arrays, **rig)
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
    files |= {"events.h5": events.getvalue(), "body.npz": body.getvalue()}
    return files | {"capture.json": json.dumps(document).encode()}


def write_event_file(
    path: Path | BytesIO, t: np.ndarray, x: np.ndarray, y: np.ndarray, p: np.ndarray
) -> None:
    """Events as they are (sorted or not) in the layout of format version 1, with p in {0, 1}."""
    with h5py.File(path, "w") as file:
        for key, values, dtype in (("t", t, "i8"), ("x", x, "u2"), ("y", y, "u2"), ("p", p, "u1")):
            file.create_dataset(
                f"events/{key}", data=values.astype(dtype), chunks=True, compression="gzip"
            )
        last_ms = int(t.max()) // 1000 if len(t) else 0
        earlier = np.searchsorted(np.sort(t), 1000 * np.arange(last_ms + 2))
        file["ms_to_idx"] = earlier.astype(np.uint64)
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


def _pose(times_us: np.ndarray, phase: float) -> tuple[np.ndarray, np.ndarray]:
    """Axis-angle (T, 3, 3) and root shift (T, 3): the body sways, the arm swings about y."""
    angle = times_us * 1e-6 * 2 * np.pi / 0.5 + phase
    poses, transl = np.zeros((len(angle), 3, 3)), np.zeros((len(angle), 3))
    poses[:, 0, 2], poses[:, 2, 1] = 0.3 * np.sin(angle / 2), 0.9 * np.sin(angle)
    transl[:, 0] = 0.15 * np.cos(angle / 2)
    return poses, transl


def _posed_vertices(rig: dict[str, np.ndarray], times_us: np.ndarray, phase: float) -> np.ndarray:
    """Linear blend skinning (T, V, 3), written out."""
    poses, transl = _pose(times_us, phase)
    turns = Rotation.from_rotvec(poses.reshape(-1, 3)).as_matrix().reshape(*poses.shape, 3)
    rest = rig["rest_joints"]
    rotations, origins = [turns[:, 0]], [rest[0] + transl]
    for joint, parent in enumerate(rig["parents"][1:], 1):
        rotations.append(rotations[parent] @ turns[:, joint])
        origins.append(origins[parent] + rotations[parent] @ (rest[joint] - rest[parent]))
    posed = [
        (rig["rest_vertices"] - joint) @ rotation.swapaxes(1, 2) + origin[:, None]
        for joint, rotation, origin in zip(rest, rotations, origins, strict=True)
    ]
    return np.einsum("vj,jtvc->tvc", rig["weights"], np.array(posed))


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
    rig: dict[str, np.ndarray],
    camera: dict,
    background: np.ndarray,
    times_us: np.ndarray,
    phase: float,
) -> tuple[np.ndarray, np.ndarray]:
    """sRGB pictures (T, H, W, 3) and person masks (T, H, W) in [0, 1], four times oversampled."""
    pose = np.array(camera["world_to_camera"])
    seen = _posed_vertices(rig, times_us, phase) @ pose[:3, :3].T + pose[:3, 3]
    pixels = (seen @ np.array(camera["K"]).T)[..., :2] / seen[..., 2:]
    pictures, masks = background, np.float32(0)
    for faces, colour in (
        (rig["faces"][:12], [0.9, 0.3, 0.2]),
        (rig["faces"][12:], [0.2, 0.3, 0.95]),
    ):
        cover = np.array([_cover(corners, camera) for corners in pixels[:, faces]])
        alpha = cover[..., None]
        pictures = pictures * (1 - alpha) + alpha * np.float32(colour)
        masks = np.maximum(masks, cover)
    return pictures, masks


def _cover(triangles: np.ndarray, camera: dict) -> np.ndarray:
    """How much of each pixel triangles (F, 3, 2) cover together, (H, W) in [0, 1]."""
    scale, size = 4, (camera["width"], camera["height"])
    mask = Image.new("L", (scale * size[0], scale * size[1]))
    draw = ImageDraw.Draw(mask)
    for corners in (scale * triangles).reshape(-1, 6).tolist():
        draw.polygon(corners, fill=255)
    return np.asarray(mask.resize(size, Image.Resampling.BOX), dtype=np.float32) / 255


def _simulate_events(linear: np.ndarray, times: np.ndarray) -> tuple[np.ndarray, ...]:
    """Noise-free events of (T, H, W, 3) linear pictures at ``times``, sorted, p in {0, 1}."""
    log_luma = np.log(linear @ np.array([0.2126, 0.7152, 0.0722]) + 1e-3)
    level = log_luma[0].copy()
    steps = []
    for before, after, target in zip(times[:-1], times[1:], log_luma[1:], strict=True):
        crossings = np.trunc((target - level) / CONTRAST).astype(int)
        level += crossings * CONTRAST
        y, x = np.nonzero(crossings)
        count = np.abs(crossings[y, x])
        pixel = np.repeat(np.arange(len(count)), count)
        nth = 1 + np.arange(len(pixel)) - (np.cumsum(count) - count)[pixel]
        t = before + nth / count[pixel] * (after - before)
        steps.append((t, x[pixel], y[pixel], crossings[y, x][pixel] > 0))
    t, x, y, p = (np.concatenate(column) for column in zip(*steps, strict=True))
    order = np.argsort(t, kind="stable")
    return t[order].astype(np.int64), x[order], y[order], p[order].astype(int)


def _png(image: np.ndarray) -> bytes:
    file = BytesIO()
    Image.fromarray((image.clip(0, 1) * 255 + 0.5).astype(np.uint8)).save(file, "PNG")
    return file.getvalue()
