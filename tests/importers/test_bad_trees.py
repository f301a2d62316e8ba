"""What is wrong with a tree is said in one sentence that names the file; nothing is left behind."""

import json
import os
import pickle
import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from evsplat.body.smpl import ENVIRONMENT
from evsplat.cli import main
from evsplat.errors import ConfigError, DataError, EvsplatError
from evsplat.importers import KINDS, import_capture
from evsplat.untrusted.arrays import read_npy, read_npz
from evsplat.untrusted.pickles import read_pickle

from . import trees
from .person import write_smpl

Change = Callable[[Path], object]


def write(kind: str, root: Path) -> tuple[str, Path, dict]:
    """A good tree: its kind, the folder to import and options."""
    if kind == "arah":
        return "zju-mocap", trees.write_zju_arah(root), {}
    if kind == "mmhpsd":
        trees.write_mmhpsd_a(root)
        return kind, root, {"action": trees.ACTION}
    if kind == "mmhpsd raw":
        trees.write_mmhpsd_raw(root, signed=True)
        return "mmhpsd", root / trees.ACTION, {}
    if kind == "zju-mocap-blur":
        trees.write_zju_blur(root, unit=1.0)
        return kind, root, {}
    writers = {
        "zju-mocap": trees.write_zju_raw,
        "neuman": trees.write_neuman,
        "people-snapshot": trees.write_people_snapshot,
    }
    return kind, writers[kind](root), {}


def remove(name: str) -> Change:
    def change(root: Path) -> None:
        path = root / name
        shutil.rmtree(path) if path.is_dir() else path.unlink()

    return change


def pipe(name: str) -> Change:
    def change(root: Path) -> None:
        (root / name).unlink()
        os.mkfifo(root / name)

    return change


def edit(name: str, change: Callable[[dict], object]) -> Change:
    """Change the dictionary in an .npy, .npz, .pkl or .json file."""

    def apply(root: Path) -> None:
        path = root / name
        if path.suffix == ".json":
            content = json.loads(path.read_text())
            change(content)
            path.write_text(json.dumps(content))
        elif path.suffix == ".npz":
            content = read_npz(path)
            change(content)
            np.savez(path, **content)
        elif path.suffix == ".npy":
            content = read_npy(path)
            change(content)
            np.save(path, np.array(content, dtype=object))
        else:
            content = read_pickle(path)
            change(content)
            path.write_bytes(pickle.dumps(content))

    return apply


def replace(name: str, old: str, new: str) -> Change:
    return lambda root: (root / name).write_text((root / name).read_text().replace(old, new))


def zero_turn(root: Path) -> None:
    path = root / "sparse" / "images.txt"
    lines = path.read_text().splitlines()
    at = next(n for n, line in enumerate(lines) if line.endswith(".png"))
    words = lines[at].split()
    lines[at] = " ".join([words[0], "0", "0", "0", "0", *words[5:]])
    path.write_text("\n".join(lines) + "\n")


class Call:
    def __reduce__(self):
        return os.system, ("touch touched",)


def poison(name: str) -> Change:
    return lambda root: (root / name).write_bytes(pickle.dumps({"poses": Call()}))


def poison_npy(root: Path) -> None:
    np.save(root / "new_params/2.npy", np.array({"poses": Call()}, dtype=object))


def shorten(name: str, key: str) -> Change:
    def change(root: Path) -> None:
        with h5py.File(root / name, "r+") as file:
            rows = file[key][:-1]
            del file[key]
            file[key] = rows

    return change


def drop(*keys: str) -> Callable[[dict], object]:
    def change(content: dict) -> None:
        for key in keys[:-1]:
            content = content[key]
        content.pop(keys[-1])

    return change


FRAME = "frame_000012"
FAULTS: dict[str, tuple[str, Change, str]] = {
    "no annotations": (
        "zju-mocap",
        remove("annots.npy"),
        r"tree: holds neither annots.npy .* nor cam_params.json",
    ),
    "annotations without cameras": (
        "zju-mocap",
        edit("annots.npy", drop("cams")),
        r"annots.npy: found no 'cams' and 'ims'",
    ),
    "annotations without lenses": (
        "zju-mocap",
        edit("annots.npy", drop("cams", "D")),
        r"annots.npy: cams: camera 0: no 'D'",
    ),
    "mirrored camera": (
        "zju-mocap",
        edit("annots.npy", lambda c: c["cams"]["R"].__setitem__(0, np.diag([1, 1, -1]))),
        r"annots.npy: cams: R of camera 0: found a matrix that is no rotation",
    ),
    "missing picture": (
        "zju-mocap",
        remove("Camera_B1/000003.jpg"),
        r"Camera_B1/000003.jpg: not found, expected the picture of frame 3",
    ),
    "missing parameters": (
        "zju-mocap",
        remove("new_params/4.npy"),
        r"new_params: has no pose of frame 4 \(1 of 6 are missing\)",
    ),
    "no parameters": (
        "zju-mocap",
        remove("new_params"),
        r"new_params: not found, expected the folder of SMPL parameters",
    ),
    "code in parameters": (
        "zju-mocap",
        poison_npy,
        r"2.npy: holds the pickled type posix.system, which no",
    ),
    "camera without entry": (
        "arah",
        edit("cam_params.json", drop("2")),
        r"cam_params.json: 2: found a NoneType, expected K, D, R and T",
    ),
    "no camera names": (
        "arah",
        edit("cam_params.json", drop("all_cam_names")),
        r"cam_params.json: all_cam_names: not found",
    ),
    "no models": ("arah", remove("models"), r"models: not found, expected the folder of ARAH's"),
    "damaged model": (
        "arah",
        lambda root: (root / "models/000001.npz").write_bytes(b"PK"),
        r"000001.npz: not a readable",
    ),
    "no MMHPSD": (
        "mmhpsd",
        lambda root: (remove("full_pic_256")(root), remove("events_256")(root)),
        r"tree: holds neither event_camera/ .* nor mmhpsd_events/",
    ),
    "code in a pose": (
        "mmhpsd",
        poison(f"pose_events/{trees.ACTION}/pose0001.pkl"),
        r"pose0001.pkl: holds the pickled type posix.system",
    ),
    "another pose file": (
        "mmhpsd",
        lambda root: (root / "pose_events" / trees.ACTION / "pose0002.pkl").write_bytes(
            pickle.dumps([1])
        ),
        r"pose0002.pkl: not MMHPSD",
    ),
    "no pictures": (
        "mmhpsd raw",
        remove("event_camera/full_pic"),
        r"full_pic: not found, expected the folder of grey pictures",
    ),
    "damaged events": (
        "mmhpsd raw",
        lambda root: (root / "event_camera/events/event0002.csv").write_text("1,2,3\nx"),
        r"event0002.csv: ",
    ),
    "a pipe": (
        "neuman",
        pipe("sparse/cameras.txt"),
        r"cameras.txt: a device or pipe, expected a file",
    ),
    "a camera without a number": (
        "neuman",
        replace("sparse/cameras.txt", "1 SIMPLE_RADIAL", "1" * 5001 + " SIMPLE_RADIAL"),
        r"cameras.txt: line 2: found '1{60}', expected the number of a camera",
    ),
    "no COLMAP": ("neuman", remove("sparse"), r"sparse: holds no images.txt"),
    "binary COLMAP": (
        "neuman",
        lambda root: (root / "sparse/images.txt").rename(root / "sparse/images.bin"),
        r"sparse: holds no images.txt, .*colmap model_converter --output_type TXT",
    ),
    "fish-eye": (
        "neuman",
        replace("sparse/cameras.txt", "SIMPLE_RADIAL", "OPENCV_FISHEYE"),
        r"cameras.txt: line 2: found camera model 'OPENCV_FISHEYE', expected one of",
    ),
    "picture without pose": (
        "neuman",
        replace("sparse/images.txt", "00003.png", "other.png"),
        r"images.txt: names no picture 00003.png \(1 of 6 are missing\)",
    ),
    "torn line": (
        "neuman",
        replace("sparse/images.txt", " 1 00002.png", ""),
        r"images.txt: line 6: found .* expected IMAGE_ID QW",
    ),
    "endless focal length": (
        "neuman",
        replace("sparse/cameras.txt", "140.0", "1e400"),
        r"cameras.txt: line \d+: found '1e400 .* expected finite numbers",
    ),
    "no rotation": (
        "neuman",
        zero_turn,
        r"images.txt: line \d+: QW QX QY QZ are 0 0 0 0, expected a rotation",
    ),
    "fewer poses": (
        "neuman",
        edit(
            "4d_humans/smpl_optimized_aligned_scale.npz",
            lambda c: c.update(global_orient=c["global_orient"][1:]),
        ),
        r"scale.npz: holds 5 poses, expected 6 as there are pictures",
    ),
    "no aligned poses": (
        "neuman",
        remove("4d_humans"),
        r"smpl_optimized_aligned_scale.npz: not found, expected the poses in COLMAP's world",
    ),
    "no video": ("people-snapshot", remove("tree.mp4"), r"tree: holds 0 .mp4 files"),
    "camera without focal length": (
        "people-snapshot",
        edit("camera.pkl", drop("camera_f")),
        r"camera.pkl: no 'camera_f'",
    ),
    "camera of another size": (
        "people-snapshot",
        edit("camera.pkl", lambda c: c.update(width=64)),
        r"tree.mp4: has 128x128 pixels, expected 64x128 of camera.pkl",
    ),
    "fewer masks": (
        "people-snapshot",
        shorten("masks.hdf5", "masks"),
        r"masks.hdf5: masks: expected 4 masks",
    ),
    "damaged video": (
        "people-snapshot",
        lambda root: (root / "tree.mp4").write_bytes(b"no video"),
        r"tree.mp4: cannot be decoded",
    ),
    "no times": (
        "zju-mocap-blur",
        edit("event_info.pkl", drop("tF")),
        r"event_info.pkl: tF: found a NoneType, expected the time of every frame",
    ),
    "no time of a frame": (
        "zju-mocap-blur",
        edit("event_info.pkl", drop("tF", FRAME)),
        rf"event_info.pkl: tF: has no frame {FRAME}",
    ),
    "times in no unit": (
        "zju-mocap-blur",
        edit("event_info.pkl", lambda c: c.update(tF={k: v * 1e-6 for k, v in c["tF"].items()})),
        r"event_info.pkl: tF: frame_\d+ and frame_\d+: found times 0.02 us apart",
    ),
    "two frames of one time": (
        "zju-mocap-blur",
        edit("event_info.pkl", lambda c: c["tF"].__setitem__(FRAME, c["tF"]["frame_000006"])),
        rf"event_info.pkl: tF: frame_000006 and {FRAME}: found times 0 us apart, expected more",
    ),
    "event beside the picture": (
        "zju-mocap-blur",
        edit("event_info.pkl", lambda c: c["xE"].__setitem__(7, 128)),
        r"event_info.pkl: xE\[7\], yE\[7\]: found 128, .* expected a pixel of the 128x136",
    ),
    "no pose of a frame": (
        "zju-mocap-blur",
        edit("mesh_infos.pkl", drop(FRAME)),
        rf"mesh_infos.pkl: {FRAME}: not found, expected a pose",
    ),
    "no camera of a frame": (
        "zju-mocap-blur",
        edit("cameras.pkl", drop(FRAME)),
        rf"cameras.pkl: {FRAME}: not found, expected a camera",
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_bad_tree_is_one_sentence(tmp_path: Path, monkeypatch, fault: str) -> None:
    monkeypatch.delenv(ENVIRONMENT, raising=False)
    monkeypatch.chdir(tmp_path)
    tree, change, message = FAULTS[fault]
    kind, source, options = write(tree, tmp_path / "tree")
    if kind == "people-snapshot":
        options["gender"] = "male"
    change(source)
    with pytest.raises(DataError, match=message) as caught:
        import_capture(kind, source, tmp_path / "out", **options)
    assert "\n" not in str(caught.value)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["tree"]


BAD_OPTIONS = {
    "kind": (("zju-mocab", {}), "'zju-mocab' is no kind of source; did you mean 'zju-mocap'"),
    "option": (("zju-mocap", {"shrin": 2}), "shrin: no such option; did you mean shrink"),
    "camera": (("zju-mocap", {"camera": "5"}), "has no camera '5'; there are 1, 2, 7"),
    "frames": (("zju-mocap", {"frames": (90, 99)}), r"no frame in 90..98; there are 0..5"),
    "shrink": (("zju-mocap", {"shrink": 0}), "--shrink 0: expected a number above 0"),
    "fps": (("zju-mocap", {"fps": -1.0}), "--fps -1: expected a number above 0"),
}


@pytest.mark.parametrize("fault", BAD_OPTIONS)
def test_a_bad_option_is_one_sentence(tmp_path: Path, fault: str) -> None:
    (kind, options), message = BAD_OPTIONS[fault]
    source = trees.write_zju_raw(tmp_path / "tree")
    with pytest.raises(ConfigError, match=message):
        import_capture(kind, source, tmp_path / "out", **options)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["tree"]


@pytest.mark.parametrize("duty", [1.01, 2.5])
def test_events_of_a_frame_do_not_reach_into_the_next(tmp_path: Path, duty: float) -> None:
    kind, source, options = write("mmhpsd raw", tmp_path / "tree")
    with pytest.raises(ConfigError, match=f"--event-duty {duty:g}: expected a share"):
        import_capture(kind, source, tmp_path / "out", event_duty=duty, **options)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["tree"]


def test_many_actions_need_a_choice(tmp_path: Path) -> None:
    trees.write_mmhpsd_a(tmp_path / "tree")
    with pytest.raises(DataError, match="holds many actions; choose one with --action"):
        import_capture("mmhpsd", tmp_path / "tree", tmp_path / "out")


def test_a_missing_body_model_is_named_where_one_was_given(tmp_path: Path) -> None:
    source = trees.write_zju_raw(tmp_path / "tree")
    with pytest.raises(EvsplatError, match=r"SMPL \(neutral\): download it"):
        import_capture("zju-mocap", source, tmp_path / "out", smpl=tmp_path)


@pytest.mark.parametrize("kind", KINDS)
def test_the_command_line_knows_every_kind(kind: str, tmp_path: Path, capsys) -> None:
    """Every kind has help and options, and a missing source is exit code 2."""
    with pytest.raises(SystemExit) as stop:
        main(["import", kind, "--help"])
    assert stop.value.code == 0
    assert "--out" in capsys.readouterr().out
    assert main(["import", kind, str(tmp_path / "none"), "--out", str(tmp_path / "out")]) == 2
    assert f"{tmp_path / 'none'}: " in capsys.readouterr().err


def test_the_command_line_imports(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.delenv(ENVIRONMENT, raising=False)
    source, out = trees.write_zju_raw(tmp_path / "CoreView_377"), tmp_path / "out"
    models = write_smpl(tmp_path / "models")
    arguments = ["import", "zju-mocap", str(source), "--out", str(out), "--smpl", str(models)]
    options = ["--frames", "1", "5", "--novel-cameras", "2", "--shrink", "1"]
    assert main([*arguments, *options]) == 0
    assert f"evsplat inspect {out}" in capsys.readouterr().out
    document = json.loads((out / "capture.json").read_text())
    assert [frame["name"] for frame in document["frames"]] == [f"{i:06d}" for i in range(1, 5)]
    assert len(document["novel_views"]) == 4 and document["body"]["model"] == "smpl"
    assert main([*arguments, *options]) == 2
    assert "already exists" in capsys.readouterr().err
    assert main([*arguments, "--overwrite"]) == 0
