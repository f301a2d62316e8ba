"""Small trees of exactly the layouts that the importers read, written from a known person."""

import functools
import json
import pickle
from pathlib import Path

import av
import h5py
import joblib
import numpy as np
from scipy.spatial.transform import Rotation

from .person import Person, View, make_person, random_rigid, save, turned_around

FRAMES = 6


@functools.cache
def drawn(view: View, person: Person, index: int) -> tuple[np.ndarray, np.ndarray]:
    """Pictures that several trees show."""
    return view.draw(person, index)


@functools.cache
def zju_views() -> dict[str, View]:
    """Three cameras with lenses, in another world than camera 1's."""
    world_to_camera = np.linalg.inv(random_rigid(1))
    K = np.array([[150.0, 0, 62.5], [0, 151.0, 66.0], [0, 0, 1]])
    lens = (-0.15, 0.06, 0.001, -0.002, 0.01)
    angles = {"1": 0.0, "2": 0.5, "7": -0.6}
    return {
        name: View((128, 136), K, turned_around(world_to_camera, angle), lens)
        for name, angle in angles.items()
    }


@functools.cache
def zju_person() -> Person:
    return make_person(3, FRAMES, random_rigid(1))


def write_zju_raw(root: Path) -> Path:
    """ZJU-MoCap as released."""
    person, views, rows = zju_person(), zju_views(), []
    for index in range(FRAMES):
        rows.append({"ims": [f"Camera_B{name}/{index:06d}.jpg" for name in views]})
        for name, view in views.items():
            picture, mask = drawn(view, person, index)
            save(root / f"Camera_B{name}" / f"{index:06d}.jpg", picture)
            labels = (mask // 255 * (3 + index)).astype(np.uint8)  # part labels, not 255
            save(root / "mask_cihp" / f"Camera_B{name}" / f"{index:06d}.png", labels)
        turn, shift = person.about_origin(index)
        poses = person.poses[index].copy()
        poses[0] = 0
        parameters = {
            "poses": poses.reshape(1, 72),
            "Rh": turn[None],
            "Th": shift[None],
            "shapes": person.betas[None],
        }
        (root / "new_params").mkdir(exist_ok=True)
        np.save(root / "new_params" / f"{index}.npy", np.array(parameters, dtype=object))
    cams = {
        "K": [view.K for view in views.values()],
        "D": [np.array(view.distortion)[:, None] for view in views.values()],
        "R": [view.world_to_camera[:3, :3] for view in views.values()],
        "T": [1000 * view.world_to_camera[:3, 3:] for view in views.values()],
    }
    np.save(root / "annots.npy", np.array({"cams": cams, "ims": rows}, dtype=object))
    return root


def write_zju_arah(root: Path, *, posed_with_shift: bool = True) -> Path:
    """ZJU-MoCap as ARAH prepares it."""
    person, views = zju_person(), zju_views()
    document: dict = {"all_cam_names": list(views)}
    for name, view in views.items():
        document[name] = {
            "K": view.K.tolist(),
            "D": list(view.distortion),
            "R": view.world_to_camera[:3, :3].tolist(),
            "T": view.world_to_camera[:3, 3:].tolist(),
        }
        for index in range(FRAMES):
            picture, mask = drawn(view, person, index)
            save(root / name / f"{index:06d}.jpg", picture)
            save(root / name / f"{index:06d}.png", mask)
    (root / "models").mkdir()
    for index in range(FRAMES):
        flat = person.poses[index].ravel()
        joints = person.joints(index) - (0 if posed_with_shift else person.transl[index])
        np.savez(
            root / "models" / f"{index:06d}.npz",
            minimal_shape=person.rest[0],
            betas=person.betas[None],
            Jtr_posed=joints,
            trans=person.transl[index],
            root_orient=flat[:3],
            pose_body=flat[3:66],
            pose_hand=flat[66:],
        )
    (root / "cam_params.json").write_text(json.dumps(document))
    return root


@functools.cache
def mmhpsd_view(width: int, height: int) -> View:
    """The grey camera of MMHPSD as its papers give it: 1679.3 and 641 on a square of 1280."""
    scale = height / 1280
    column = 641 - (1280 - width / scale) / 2
    K = np.array([[1679.3, 0, column + 0.5], [0, 1679.3, 641.5], [0, 0, 0]]) * scale
    K[2, 2] = 1
    K[:2, 2] -= 0.5
    return View((width, height), K, np.eye(4))


ACTION = "subject01_group2_time3"


@functools.cache
def mmhpsd_person() -> Person:
    return make_person(5, FRAMES)


def mmhpsd_events(rng: np.random.Generator, count: int, *, signed: bool) -> np.ndarray:
    """Rows of a raw file: v, u, in-pixel time, off-pixel time, polarity."""
    v, u = rng.integers(0, 1280, count), rng.integers(0, 800, count)
    t = np.sort(rng.integers(0, 7550, count))
    p = rng.integers(0, 2, count) if signed else np.zeros(count, int)
    return np.stack([v, u, t, t + 9, p], axis=1)


def write_mmhpsd_raw(root: Path, *, signed: bool) -> dict[int, np.ndarray]:
    """One action as recorded; gives the rows of each event file."""
    person, view = mmhpsd_person(), mmhpsd_view(800, 1280)
    camera = root / ACTION / "event_camera"
    (camera / "events").mkdir(parents=True)
    rng, files = np.random.default_rng(4), {}
    for index in range(FRAMES):
        save(camera / "full_pic" / f"fullpic{index:04d}.jpg", _grey(drawn(view, person, index)[0]))
        if index < FRAMES - 1:
            files[index] = mmhpsd_events(rng, 300, signed=signed)
            np.savetxt(camera / "events" / f"event{index:04d}.csv", files[index], "%d", ",")
    write_mmhpsd_poses(root / "pose_events" / ACTION, person)
    return files


def write_mmhpsd_a(root: Path) -> None:
    """EventHPE's release: binary event pictures, grey pictures of 256 pixels."""
    person, view = mmhpsd_person(), mmhpsd_view(256, 256)
    for index in range(FRAMES):
        name = f"{index:04d}"
        grey = _grey(drawn(view, person, index)[0])
        save(root / "full_pic_256" / ACTION / f"fullpic{name}.jpg", grey)
        save(root / "events_256" / ACTION / f"event{name}.png", np.zeros((256, 256, 4), np.uint8))
    write_mmhpsd_poses(root / "pose_events" / ACTION, person)


def write_mmhpsd_poses(folder: Path, person: Person) -> None:
    folder.mkdir(parents=True)
    for index in range(1, FRAMES):  # the first has none, as happens
        joints = person.joints(index)
        flat = person.poses[index].reshape(1, 72)
        parts = (person.betas[None], flat, person.transl[index][None], joints, joints[:, :2])
        joblib.dump(parts, folder / f"pose{index:04d}.pkl", compress=3 * (index % 2))
    joblib.dump([1, 2, 3], folder / "pose_info.pkl")


def write_mmhpsd_b(root: Path, *, matrices: bool) -> dict[int, dict[str, np.ndarray]]:
    """The release of the SNN paper; gives the events of each file."""
    person, view = mmhpsd_person(), mmhpsd_view(256, 256)
    own, rng, files = root / "mmhpsd_events" / ACTION, np.random.default_rng(6), {}
    for folder in ("events", "poses"):
        (own / folder).mkdir(parents=True)
    for index in range(FRAMES):
        grey = root / "mmhpsd_grayscale_img" / ACTION / "imgs" / f"fullpic{index:04d}.jpg"
        save(grey, _grey(drawn(view, person, index)[0]))
        files[index] = {
            "xy": rng.integers(0, 256, (200, 2)),
            "t": np.sort(rng.integers(0, 60_000, 200)),
            "p": rng.integers(0, 2, 200),
        }
        np.savez(own / "events" / f"events_{index:04d}.npz", **files[index])
        pose = person.poses[index]
        np.savez(
            own / "poses" / f"pose_{index:04d}.npz",
            beta=person.betas,
            trans=person.transl[index],
            joints3d=person.joints(index),
            body_pose=Rotation.from_rotvec(pose).as_matrix() if matrices else pose.ravel(),
        )
    return files


NEUMAN_SCALE = 0.37


@functools.cache
def neuman_views() -> list[View]:
    """A camera that walks around the person, in metres."""
    K = np.array([[140.0, 0, 63.5], [0, 140.0, 47.5], [0, 0, 1]])
    start = np.linalg.inv(random_rigid(8))
    return [
        View((128, 96), K, turned_around(start, 0.1 * i), (0.05, 0, 0, 0, 0)) for i in range(FRAMES)
    ]


@functools.cache
def neuman_person() -> Person:
    return make_person(9, FRAMES, random_rigid(8), distance=3.8)


def write_neuman(root: Path, *, scales: np.ndarray | None = None) -> Path:
    """One sequence, in COLMAP's units; ``scales`` per frame, as HUGS's alignment gives them.

    A frame's scale moves the person along the rays of its camera, so that the picture stays.
    """
    person, views = neuman_person(), neuman_views()
    scales = np.full(FRAMES, NEUMAN_SCALE) if scales is None else scales
    (root / "sparse").mkdir(parents=True)
    lines, transl = ["# images"], []
    for index, view in enumerate(views):
        picture, mask = view.draw(person, index)
        save(root / "images" / f"{index:05d}.png", picture)
        save(root / "segmentations" / f"{index:05d}.png.png", 255 - mask)
        pose = view.world_to_camera
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
        shift = NEUMAN_SCALE * pose[:3, 3]
        words = [index + 1, w, x, y, z, *shift, 1, f"{index:05d}.png"]
        lines += [" ".join(map(str, words)), "1.0 2.0 -1" if index % 2 else ""]
        centre = -pose[:3, :3].T @ pose[:3, 3]
        # v_units = s v_smpl + transl with v_metres = v_smpl + t, moved along the rays
        transl.append(scales[index] * (person.transl[index] - centre) + NEUMAN_SCALE * centre)
    (root / "sparse" / "images.txt").write_text("\n".join(lines) + "\n")
    camera = "1 SIMPLE_RADIAL 128 96 140.0 64.0 48.0 0.05\n"
    (root / "sparse" / "cameras.txt").write_text("# cameras\n" + camera)
    points = ["1 0.37 0 -0.74 255 0 51 0.5 1 2", "2 0 1 2 0 0 0 0.5"]
    (root / "sparse" / "points3D.txt").write_text("\n".join(points) + "\n")
    (root / "4d_humans").mkdir()
    np.savez(
        root / "4d_humans" / "smpl_optimized_aligned_scale.npz",
        global_orient=person.poses[:, 0],
        body_pose=person.poses[:, 1:].reshape(FRAMES, 69),
        betas=np.tile(person.betas, (FRAMES, 1)),
        transl=np.array(transl),
        scale=scales,
    )
    return root


SNAPSHOT_FRAMES = 4


@functools.cache
def snapshot_view() -> View:
    K = np.array([[150.0, 0, 63.5], [0, 150.0, 63.5], [0, 0, 1]])
    return View((128, 128), K, np.eye(4))


@functools.cache
def snapshot_person() -> Person:
    return make_person(11, SNAPSHOT_FRAMES)


def write_people_snapshot(root: Path) -> Path:
    """One subject; the video without loss."""
    person, view = snapshot_person(), snapshot_view()
    root.mkdir(parents=True)
    drawn = [view.draw(person, index) for index in range(SNAPSHOT_FRAMES)]
    with av.open(str(root / f"{root.name}.mp4"), "w") as container:
        stream = container.add_stream("libx264rgb", rate=25, options={"crf": "0"})
        stream.width, stream.height = view.size
        stream.pix_fmt = "rgb24"
        for picture, _ in drawn:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, "rgb24")))
        container.mux(stream.encode(None))
    with h5py.File(root / "masks.hdf5", "w") as file:
        file["masks"] = np.stack([mask // 255 for _, mask in drawn])
    with h5py.File(root / "reconstructed_poses.hdf5", "w") as file:
        file["pose"] = person.poses.reshape(SNAPSHOT_FRAMES, 72)
        file["trans"], file["betas"] = person.transl, person.betas
    camera = {
        "camera_t": np.zeros(3),
        "camera_rt": np.zeros(3),
        "camera_f": view.K[[0, 1], [0, 1]],
        "camera_c": view.K[:2, 2],
        "camera_k": np.zeros(5),
        "width": 128,
        "height": 128,
    }
    (root / "camera.pkl").write_bytes(pickle.dumps(camera, protocol=2))
    return root


BLUR_STEP = 6
"""Sub-frames from one blurry picture to the next."""


def blur_view() -> View:
    return zju_views()["1"]


def write_zju_blur(root: Path, *, unit: float) -> dict[str, np.ndarray]:
    """ExFMan's set, times in ``unit`` per second; gives the events."""
    person, view = zju_person(), blur_view()
    width, height = view.size
    names = [f"frame_{BLUR_STEP * index:06d}" for index in range(FRAMES)]
    cameras, infos = {}, {}
    for index, name in enumerate(names):
        picture, mask = drawn(view, person, index)
        save(root / "images" / f"{name}.png", picture)
        save(root / "masks" / f"{name}.png", np.repeat(mask[..., None], 3, axis=2))
        cameras[name] = {
            "intrinsics": view.K,
            "extrinsics": view.world_to_camera,
            "distortions": np.array(view.distortion),
        }
        turn, shift = person.about_origin(index)
        poses = person.poses[index].copy()
        poses[0] = 0
        rest = person.rest[1]
        infos[name] = {"Rh": turn, "Th": shift, "poses": poses.ravel(), "tpose_joints": rest}
    rng = np.random.default_rng(12)
    events = {
        "tE": rng.uniform(0, FRAMES * 0.02, 500) * unit,
        "xE": rng.integers(0, width, 500),
        "yE": rng.integers(0, height, 500),
        "pE": rng.choice([-1, 1], 500),
    }
    moments = {name: (0.01 + 0.02 * index) * unit for index, name in enumerate(names)}
    for name, content in (
        ("cameras", cameras),
        ("mesh_infos", infos),
        ("event_info", {**events, "tF": moments}),
        ("canonical_joints", {"joints": person.rest[1]}),
    ):
        (root / f"{name}.pkl").write_bytes(pickle.dumps(content))
    return events


def _grey(picture: np.ndarray) -> np.ndarray:
    """Grey stored as three equal channels."""
    return np.repeat(picture.mean(axis=2).round().astype(np.uint8)[..., None], 3, axis=2)
