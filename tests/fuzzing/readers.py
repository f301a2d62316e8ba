"""Everything that evsplat reads from disk: sound files of each kind, and reading them whole.

A reader may do two things with a damaged file: read it, or raise an `EvsplatError`.
"""

import gzip
import json
import math
import pickle
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from PIL import Image

from evsplat.benching.folder import BenchFolder
from evsplat.benching.given_pictures import GivenPictures
from evsplat.benching.plan import make_plan, pending_cells
from evsplat.benching.run import bench, write_output
from evsplat.benching.suite import read_suite
from evsplat.body.motion import load_motion
from evsplat.body.pose_files import read_poses
from evsplat.body.smpl import read_model_file
from evsplat.capture import load_body_track, load_capture, validate_capture
from evsplat.capture.finding import Finding
from evsplat.capture.points import read_points, write_points
from evsplat.config import override
from evsplat.errors import EvsplatError
from evsplat.evaluation.run import evaluate_run, write_report
from evsplat.events import EventStore
from evsplat.film.camera_path import read_camera_path
from evsplat.footage import open_footage
from evsplat.importers import import_capture
from evsplat.landmarks.keypoint_files import read_points as read_keypoints
from evsplat.methods import method_config
from evsplat.pictures.files import read_image
from evsplat.posing import find_poses
from evsplat.training import load_run, train
from evsplat.training.checkpoint import load_checkpoint
from evsplat.training.run import RunFolder, read_config
from evsplat.untrusted.arrays import read_npy, read_npz, read_plain_arrays, read_plain_npz
from evsplat.untrusted.pickles import read_pickle
from evsplat.untrusted.pictures import image_size
from evsplat.untrusted.text import read_json, read_text
from evsplat.weights import read_state

from ..benching.helpers import cells_in_this_process
from ..body.motion.test_motion_files import (
    acclaim_files,
    bvh_text,
    deepmimic_frames,
    random_motion,
    write_deepmimic,
)
from ..body.pose_files.synthetic import TOOLS, write, write_models
from ..conftest import write_tiny_capture
from ..events.formats import encoders, mutations
from ..events.formats.helpers import random_stream
from ..importers.test_bad_trees import write as write_tree
from ..landmarks.test_keypoints import WRITERS, points
from ..posing.moving import CAMERA, landmarks
from ..small_model import small
from .recordings import (
    Source,
    write_davis_recording,
    write_folder_recording,
    write_video_recording,
)


class Accepted(AssertionError):
    """A damaged file that was read without a word although a promise about it is broken."""


@dataclass(frozen=True)
class Reader:
    """One kind of file or folder."""

    write: Callable[[Path], object]
    """Writes sound files into an empty folder."""
    read: Callable[[Path, Path], object]
    """Reads the folder, or the damaged file in it."""
    share: int
    """Inputs of it beside those of others; about as many take a second."""
    whole: bool = False
    """Whether it reads the folder alike, whichever file in it is damaged."""


def write_capture(root: Path) -> None:
    """A capture small enough to be read in milliseconds."""
    write_tiny_capture(root, frames=4)
    document = json.loads((root / "capture.json").read_text())
    document["frames"][3]["split"] = "test"
    document["novel_views"] = [
        {
            "camera": "side",
            "frame": "0003",
            "time_us": 135_000,
            "image": "novel/side/0003.png",
        }
    ]
    (root / "novel" / "side").mkdir(parents=True, exist_ok=True)
    shutil.copy(root / "sharp" / "0003.png", root / "novel" / "side" / "0003.png")
    (root / "capture.json").write_text(json.dumps(document))
    write_points(root / "points.ply", np.random.default_rng(0).normal(size=(20, 3)).astype("f4"))
    shutil.copy(root / "body.npz", root / "body_dense.npz")


def read_capture(root: Path, damaged: Path) -> None:
    """All that training, evaluation and inspection open; what they take, the deep check takes."""
    refused = [f for f in validate_capture(root, deep=True) if f.severity == "error"]
    capture = load_capture(root)
    for frame in capture.frames:
        for picture in (capture.image(frame), capture.mask(frame)):
            if picture is not None and not picture.isfinite().all():
                raise Accepted("a picture that is not finite")
        if frame.sharp is not None:
            capture.sharp(frame)
    for view in capture.novel_views:
        capture.novel_image(view)
    if capture.events is not None:
        read_store(capture.events)
    if capture.has_body:
        for dense in (False, True):
            track = load_body_track(capture, dense=dense)
            found = track.at([frame.mid_us for frame in capture.frames])
            if not all(part.isfinite().all() for part in found):
                raise Accepted("a pose that is not finite")
    capture.initial_points()
    if refused:
        raise Accepted(f"what the deep check calls wrong: {refused[0]}"[:200])


def read_store(store: EventStore) -> None:
    """All events, in pieces as training asks for them."""
    start, end = store.time_range_us
    if end - start > 10**8:
        return
    for first in range(start, end, 20_000):
        found = store.between(first, min(first + 20_000, end))
        if len(found) and not (first <= found.t[0] and found.t[-1] < first + 20_000):
            raise Accepted("events beside the time that was asked for")
        if len(found) and (found.x.max() >= store.width or found.y.max() >= store.height):
            raise Accepted("events beside the sensor")
    if not all(map(math.isfinite, store.rate(10)[1])):
        raise Accepted("a rate that is not finite")


def finite(value: Any) -> None:
    """Every number in the fields of a dataclass is one."""
    for name, field in vars(value).items():
        if isinstance(field, np.ndarray | torch.Tensor):
            array = np.asarray(field)
            if array.dtype.kind == "f" and not np.isfinite(array).all():
                raise Accepted(f"{name} is not finite")


def write_settings(root: Path) -> None:
    """Run folders of every method, as far as settings go."""
    for method in ("evsplat", "paper", "hugs"):
        (root / f"{method}.set").write_text("\n".join(small(method)))
        sections: dict[str, Any] = override({}, small(method))
        (root / f"{method}.yaml").write_text(yaml.safe_dump({"method": method, **sections}))


def read_settings(root: Path, damaged: Path) -> None:
    """As ``--config`` and ``--set`` are."""
    if damaged.suffix == ".set":
        lines = read_text(damaged).splitlines()
        method_config(damaged.stem, override({}, lines), where="--set")
        return
    run = RunFolder(root)
    run.config.touch()  # a run has one by that name
    run.config = damaged
    run.facts = root / "versions.json"
    run.facts.write_text('{"capture": "c", "capture_name": "c", "device": "cpu", "seed": 0}')
    read_config(run)


PICKLED: tuple[Any, ...] = (
    np.arange(12.0).reshape(3, 4),
    np.array([{}, {"a": np.zeros(3)}], dtype=object),
    np.array({"a": 1, "b": np.ones((2, 2), "f4")}, dtype=object),
    {"smpl": [np.float32(3), np.int64(4)], "n": ["a", "é"], "s": {1, 2}},
    np.array(["ab", "c"]),
    np.asfortranarray(np.arange(6.0).reshape(2, 3)),
    np.array([[1, [2]], [None, "x"]], dtype=object),
)


def write_pickles(root: Path) -> None:
    """Pickles of all protocols, NumPy's files with objects, and packed ones."""
    for number, value in enumerate(PICKLED):
        for protocol in (0, 2, 4, 5):
            (root / f"{number}_{protocol}.pkl").write_bytes(pickle.dumps(value, protocol))
        np.save(root / f"{number}.npy", np.array(value, dtype=object), allow_pickle=True)
        np.savez(root / f"{number}.npz", a=np.array(value, dtype=object), b=np.arange(3))
    (root / "packed.gz").write_bytes(gzip.compress(pickle.dumps(PICKLED[0])))


def read_pickled(root: Path, damaged: Path) -> None:
    """By the reader of each suffix."""
    reader = {".pkl": read_pickle, ".gz": read_pickle, ".npy": read_npy, ".npz": read_npz}[
        damaged.suffix
    ]
    repr(reader(damaged))


def write_arrays(root: Path) -> None:
    """Plain arrays of several kinds."""
    arrays = {"a": np.arange(6.0).reshape(2, 3), "b": np.array(["x", "yz"]), "c": np.int64(3)}
    np.savez(root / "a.npz", **arrays)
    np.savez_compressed(root / "b.npz", **arrays, zeros=np.zeros(5000))
    np.save(root / "c.npy", np.asfortranarray(np.arange(6).reshape(2, 3)))


def read_arrays(root: Path, damaged: Path) -> None:
    """Plain ones, which no object is read from."""
    read_plain_arrays(damaged)
    if damaged.suffix == ".npz":
        read_plain_npz(damaged)


def write_pictures(root: Path) -> None:
    """Every kind of picture that is read."""
    rng = np.random.default_rng(0)
    rgb = Image.fromarray(rng.integers(0, 256, (12, 14, 3)).astype(np.uint8))
    for suffix in ("png", "jpg", "tiff", "bmp", "ppm", "webp", "gif", "jp2"):
        rgb.save(root / f"a.{suffix}")
    for mode in ("L", "RGBA", "LA", "P", "1"):
        rgb.convert(mode).save(root / f"{mode}.png")
    Image.fromarray(rng.integers(0, 65536, (12, 14)).astype(np.uint16)).save(root / "deep.png")


def write_videos(root: Path) -> None:
    """A short one."""
    from evsplat.pictures.video import write_animation, write_video

    frames = [np.full((16, 16, 3), value, np.uint8) for value in (0, 90, 200)]
    write_video(root / "a.mp4", frames, fps=10)
    write_animation(root / "a.gif", frames, fps=10)


def write_weights(root: Path) -> None:
    """As torch writes them, now and in former times."""
    state = {"a.weight": torch.ones(3, 4), "b": torch.zeros(2, dtype=torch.float16)}
    torch.save(state, root / "new.pth")
    torch.save(state, root / "old.pth", _use_new_zipfile_serialization=False)
    torch.save({"state_dict": state, "epoch": 3}, root / "nested.pt")


def write_motions(root: Path) -> None:
    """A motion of each format."""
    angles, place = random_motion(0)
    (root / "a.bvh").write_text(bvh_text(angles, place, "zxy"))
    acclaim_files(root, angles, place, np.zeros((len(angles[0]), 3)))
    write_deepmimic(root / "m.txt", deepmimic_frames())


def read_motion(root: Path, damaged: Path) -> None:
    """The damaged file, or the motion of the damaged skeleton."""
    finite(load_motion(root / "07_01.amc" if damaged.suffix == ".asf" else damaged))


def write_poses(root: Path) -> None:
    """A file of each tool, and body models."""
    (root / "models").mkdir()
    write_models(root / "models")
    for tool in TOOLS:
        written = write(tool, root / tool).path
        (root / f"{tool}.where").write_text(written.relative_to(root).as_posix())


def read_tool(root: Path, damaged: Path) -> None:
    """The tool's file or folder."""
    tool = damaged.relative_to(root).parts[0]
    if tool == "models":
        read_model_file(damaged)
    else:
        path = root / (root / f"{tool}.where").read_text()
        finite(read_poses(path, body_models=root / "models"))


def write_keypoints(root: Path) -> None:
    """Of every form."""
    for name, writer in WRITERS.items():
        writer(root / name, points(17))


def read_points_of(root: Path, damaged: Path) -> None:
    """A file, or the folder that it is one of."""
    read_keypoints(damaged if damaged.parent == root else damaged.parent)


def write_path(root: Path) -> None:
    """A camera path with both forms of keys."""
    eye = {"eye": [0, -3, 1.5], "target": [0, 0, 1], "up": [0, 0, 1], "fov_y_deg": 40}
    K = [[100, 0, 32], [0, 100, 24], [0, 0, 1]]
    pose = {"world_to_camera": np.eye(4).tolist(), "K": K}
    keys = [{"at": 0.0, **eye}, {"at": 0.5, **pose}, {"at": 1.0, **eye}]
    document = {"format": "evsplat-camera-path", "version": 1, "width": 64, "height": 48}
    (root / "path.json").write_text(json.dumps({**document, "keys": keys}))


def read_path(root: Path, damaged: Path) -> None:
    """Cameras all along it are finite."""
    path = read_camera_path(damaged)
    for share in (0.0, 0.3, 1.0):
        finite(path(share))


def write_store(root: Path) -> None:
    """The events of the tiny capture."""
    write_tiny_capture(root / "capture", frames=4)
    (root / "capture" / "events.h5").rename(root / "events.h5")
    shutil.rmtree(root / "capture")


def read_events(root: Path, damaged: Path) -> None:
    """The event file of a capture."""
    read_store(EventStore(damaged, 32, 24))


def write_recordings(root: Path) -> None:
    """One of every format, named by it."""
    for name, (kind, data) in mutations.seeds(encoders, random_stream(0, 300)).items():
        suffix = ".bag" if name == "bag" else ""
        (root / f"{name.replace(' ', '_')}@{kind}{suffix}").write_bytes(data)


def read_recording(root: Path, damaged: Path) -> str:
    """All of it, in order and within the sensor."""
    kind = damaged.name.partition("@")[2].removesuffix(".bag")
    return mutations.outcome(
        damaged, kind, repair=damaged.is_file() and damaged.stat().st_size % 2 == 0
    )


def write_run(root: Path) -> None:
    """A run of two steps on poses that err; its capture lies beside the folder."""
    capture = root.with_name(f"{root.name} capture")
    write_capture(capture)
    document = json.loads((capture / "capture.json").read_text())
    document["body"]["source"] = "estimated"
    (capture / "capture.json").write_text(json.dumps(document))
    train(
        capture,
        out=root / "run",
        method="evsplat",
        overrides=small("evsplat"),
        iterations=2,
        any_body=True,
        threads=1,
    )


def write_started(root: Path) -> None:
    """A run of poses that err, whose checkpoint holds all that a resume needs."""
    write_run(root)
    (root / "run" / "log.jsonl").unlink()  # damaged lines of it are dropped
    (root / "capture.where").write_text(json.dumps(str(root.with_name(f"{root.name} capture"))))


def read_resumed(root: Path, damaged: Path) -> None:
    """The training gone on with, in a copy: what it saves is sound, or nothing is saved."""
    out = root.with_name(f"{root.name}-out")
    shutil.rmtree(out, ignore_errors=True)
    shutil.copytree(root / "run", out, symlinks=True)
    before = {path.name for path in (out / "checkpoints").iterdir()}
    capture = Path(json.loads((root / "capture.where").read_text()))
    train(capture, out=out, resume=True, iterations=4, any_body=True, threads=1)
    for path in (out / "checkpoints").iterdir():
        if path.name not in before:
            tensors, _ = load_checkpoint(path)
            if not all(value.isfinite().all() for value in tensors.values()):
                raise Accepted(f"{path.name} holds numbers that are not finite")


def write_evaluated(root: Path) -> None:
    """A run that was evaluated."""
    write_run(root)
    evaluate_run(root / "run")


def read_run(root: Path, damaged: Path) -> None:
    """The run with its checkpoint, drawn."""
    run = load_run(root / "run")
    finite(run.reconstruction.render(run.capture.camera("0000"), [15_000]))


def read_report(root: Path, damaged: Path) -> None:
    """The page made anew."""
    write_report(root / "run")


def write_bench(root: Path) -> None:
    """A bench of what is not trained."""
    capture = root.with_name(f"{root.name} capture")
    write_tiny_capture(capture, frames=10)
    suite = {
        "name": "tiny",
        "captures": [{"name": "tiny", "path": str(capture)}],
        "rows": [{"name": name, "method": name} for name in ("median_background", "nearest_frame")],
    }
    (root / "suite.yaml").write_text(yaml.safe_dump(suite))
    with cells_in_this_process():
        bench(root / "suite.yaml", out=root / "bench", jobs=1)


def read_bench(root: Path, damaged: Path) -> None:
    """The plan and the tables of what is there."""
    folder = BenchFolder(root / "bench")
    plan = make_plan(read_suite(root / "suite.yaml"), folder)
    pending_cells(plan, folder, retry=False)
    write_output(plan, folder)


def write_kept(root: Path) -> None:
    """Records that are kept, and pictures made elsewhere, with the suite that they are for."""
    beside = root.with_name(f"{root.name} bench")
    beside.mkdir()
    write_bench(beside)
    (beside / "suite.yaml").rename(root / "suite.yaml")
    shutil.rmtree(beside / "bench")
    with cells_in_this_process():
        bench(root / "suite.yaml", out=beside / "bench", records=root / "records", jobs=1)
    shutil.copytree(root.with_name(f"{beside.name} capture") / "sharp", root / "theirs" / "tiny")


def read_kept(root: Path, damaged: Path) -> None:
    """The tables made of the records alone, and the pictures as a method would draw them."""
    suite = read_suite(root / "suite.yaml")
    out = root.with_name(f"{root.name}-out")
    shutil.rmtree(out, ignore_errors=True)
    folder = BenchFolder(out, root / "records")
    plan = make_plan(suite, folder)
    pending_cells(plan, folder, retry=False)
    write_output(plan, folder)
    for source in plan.sources.values():
        capture = load_capture(source.path)
        given = GivenPictures(root / "theirs" / "tiny", capture)
        for frame in capture.test_frames:
            given.render(capture.camera(frame), [frame.mid_us])


def write_unposed(root: Path) -> None:
    """A capture without poses and the points of somebody in it."""
    write_capture(root / "capture")
    document = json.loads((root / "capture" / "capture.json").read_text())
    document["body"], document["novel_views"] = None, []
    for frame in document["frames"]:
        frame["split"] = "train"  # a motion is not fitted to three pictures
    document["cameras"]["main"]["K"] = [[37.5, 0, 16], [0, 37.5, 16], [0, 0, 1]]
    document["cameras"]["main"]["world_to_camera"] = CAMERA.world_to_camera.tolist()
    (root / "capture" / "capture.json").write_text(json.dumps(document))
    for name in ("body.npz", "body_dense.npz", "points.ply"):
        (root / "capture" / name).unlink()
    marks = landmarks(4)
    points = np.concatenate((marks.places / 8, marks.seen[..., None]), -1)
    np.savez(root / "points.npz", keypoints=points)


def read_found(root: Path, damaged: Path) -> None:
    """Poses found by the points: a capture that is sound, or none."""
    out = root.with_name(f"{root.name}-out")
    shutil.rmtree(out, ignore_errors=True)
    try:
        find_poses(root / "capture", out, keypoints=root / "points.npz", refine_s=0)
    except EvsplatError:
        if out.exists():
            raise Accepted("a capture left behind, though it is refused") from None
        raise
    if not wrong_in(root / "capture") and wrong_in(out):
        raise Accepted(f"what the check calls wrong: {wrong_in(out)[0]}")


def wrong_in(capture: Path) -> list[Finding]:
    """Errors of a capture; what nobody opened on the way is copied with its faults."""
    return [found for found in validate_capture(capture) if found.severity == "error"]


def tree(kind: str) -> Reader:
    """A data set of a kind, imported."""

    def write_data(root: Path) -> None:
        # People-Snapshot's sequences begin with the gender.
        name, source, options = write_tree(kind, root / "female-1")
        place = source.relative_to(root).as_posix()
        (root / "how.where").write_text(json.dumps([name, place, options, {}]))

    return Reader(write_data, read_import, 3, whole=True)


def own(kind: str, write: Callable[[Path], Source], share: int) -> Reader:
    """A recording of one's own, imported."""

    def write_data(root: Path) -> None:
        (root / "how.where").write_text(json.dumps([kind, *write(root)]))

    return Reader(write_data, read_import, share, whole=True)


def read_import(root: Path, damaged: Path) -> None:
    """The import that how.where tells of: a capture that is sound, or none."""
    name, place, options, files = json.loads((root / "how.where").read_text())
    out = root.with_name(f"{root.name}-out")
    shutil.rmtree(out, ignore_errors=True)
    options |= {option: root / file for option, file in files.items()}
    try:
        import_capture(name, root / place, out, **options)
        for finding in validate_capture(out):
            if finding.severity == "error":
                raise Accepted(f"what the check calls wrong: {finding}")
    except EvsplatError:
        if out.exists():
            raise Accepted("a capture left behind, though it is refused") from None
        raise


def read_training(root: Path, damaged: Path) -> None:
    """Three steps, of which each must be sound."""
    out = root.with_name(f"{root.name}-out")
    shutil.rmtree(out, ignore_errors=True)
    train(
        root,
        out=out,
        method="evsplat",
        overrides=small("evsplat"),
        iterations=3,
        any_body=True,
        threads=1,
    )
    load_checkpoint(next((out / "checkpoints").iterdir()))


def _write_json(root: Path) -> None:
    write_tiny_capture(root / "c", frames=2)
    (root / "c" / "capture.json").rename(root / "capture.json")
    shutil.rmtree(root / "c")


def _write_points(root: Path) -> None:
    rng = np.random.default_rng(0)
    places, colours = rng.normal(size=(20, 3)).astype("f4"), rng.random((20, 3)).astype("f4")
    write_points(root / "plain.ply", places)
    write_points(root / "coloured.ply", places, colours)
    head = "ply\nformat ascii 1.0\nelement vertex 3\n" + "".join(
        f"property float {axis}\n" for axis in "xyz"
    )
    (root / "text.ply").write_text(head + "end_header\n1 2 3\n4 5 6\n7 8 9\n")


def _write_checkpoint(root: Path) -> None:
    write_run(beside := root.with_name(f"{root.name} of"))
    for file in (beside / "run" / "checkpoints").iterdir():
        shutil.copy(file, root)


READERS = {
    "json": Reader(_write_json, lambda root, file: read_json(file), 6_000),
    "settings": Reader(write_settings, read_settings, 250),
    "arrays": Reader(write_arrays, read_arrays, 3_000),
    "pickles": Reader(write_pickles, read_pickled, 3_000),
    "points": Reader(_write_points, lambda root, file: read_points(file), 4_000),
    "poses": Reader(write_poses, read_tool, 150),
    "motions": Reader(write_motions, read_motion, 300),
    "keypoints": Reader(write_keypoints, read_points_of, 500),
    "camera paths": Reader(write_path, read_path, 1_000),
    "pictures": Reader(
        write_pictures, lambda root, file: (image_size(file), read_image(file)), 800
    ),
    "videos": Reader(write_videos, lambda root, file: list(open_footage(file)), 60),
    "weights": Reader(write_weights, lambda root, file: read_state(file), 600),
    "checkpoints": Reader(_write_checkpoint, lambda root, file: load_checkpoint(file), 500),
    "event files": Reader(write_store, read_events, 100),
    "recordings": Reader(write_recordings, read_recording, 250),
    "captures": Reader(write_capture, read_capture, 25, whole=True),
    "runs": Reader(write_run, read_run, 3, whole=True),
    "reports": Reader(write_evaluated, read_report, 1, whole=True),
    "resumed runs": Reader(write_started, read_resumed, 2, whole=True),
    "benches": Reader(write_bench, read_bench, 10, whole=True),
    "kept records": Reader(write_kept, read_kept, 10, whole=True),
    "found poses": Reader(write_unposed, read_found, 2, whole=True),
    "training": Reader(write_capture, read_training, 1, whole=True),
    **{
        f"import {kind}": tree(kind)
        for kind in (
            *("zju-mocap", "arah", "mmhpsd", "mmhpsd raw", "neuman", "people-snapshot"),
            "zju-mocap-blur",
        )
    },
    "import video": own("video", write_video_recording, 20),
    "import davis": own("davis", write_davis_recording, 20),
    "import folder": own("folder", write_folder_recording, 20),
}
"""By name."""
