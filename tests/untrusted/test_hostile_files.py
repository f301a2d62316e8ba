"""Files made to do harm, and those that the fuzzer found: one sentence each, and little memory."""

import gzip
import io
import json
import os
import pickle
import signal
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import save_file

from evsplat.body.motion import load_motion
from evsplat.body.pose_files import read_poses
from evsplat.capture import load_body_track, load_capture
from evsplat.capture.points import read_points
from evsplat.config import override
from evsplat.errors import EvsplatError
from evsplat.events import EventStore
from evsplat.film.camera_path import read_camera_path
from evsplat.footage import open_footage
from evsplat.landmarks.keypoint_files import read_points as read_keypoints
from evsplat.methods import method_config
from evsplat.pictures.files import read_image
from evsplat.untrusted.arrays import read_npz, read_plain_npz
from evsplat.untrusted.hdf5 import holds, open_hdf5
from evsplat.untrusted.pickles import read_pickle
from evsplat.untrusted.records import misfit
from evsplat.untrusted.tensors import read_safetensors
from evsplat.weights import read_state

from ..conftest import write_tiny_capture

BVH = (
    "HIERARCHY ROOT a {{ OFFSET {offset} CHANNELS 1 Xposition JOINT b {{ OFFSET 0 1 0 CHANNELS 0 "
    "End Site {{ OFFSET 0 1 0 }} }} }} MOTION Frames: 1 Frame Time: {time} 0"
)


def refused(read: Callable[[], object]) -> str:
    with pytest.raises(EvsplatError) as error:
        read()
    said = str(error.value)
    assert "\n" not in said and len(said) < 700
    return said


@pytest.mark.parametrize(
    ("name", "read"),
    [
        ("a.ply", read_points),
        ("a.pth", read_state),
        ("a.npz", read_plain_npz),
        ("a.pkl", read_pickle),
        ("a.png", read_image),
        ("a.bvh", load_motion),
        ("a.json", read_camera_path),
        ("a.h5", lambda path: len(EventStore(path, 4, 4))),
    ],
)
def test_what_never_ends_is_not_opened(tmp_path: Path, name: str, read: Callable) -> None:
    path = tmp_path / name
    os.mkfifo(path)
    assert "a device or pipe, expected a file" in refused(lambda: read(path))
    path.unlink()
    path.symlink_to("/dev/zero")
    assert "a device or pipe, expected a file" in refused(lambda: read(path))
    path.unlink()
    path.mkdir()
    assert "a folder, expected a file" in refused(lambda: read(path))


def npy(shape: str, kind: str = "<f8", content: bytes = b"") -> bytes:
    head = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}".encode()
    head += b" " * (63 - (len(head) + 10) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head + content


@pytest.mark.parametrize(
    ("member", "said"),
    [
        (npy("(10000000000000,)"), "an array of shape (10000000000000,) in"),
        (npy("(-5,)"), "an array of shape (-5,)"),
        (npy("(2,)", "<U1", b"\xff" * 8), "texts that hold no characters"),
        (npy("(1,)", "<M8", b"\0" * 8), "an array of datetime64"),
        (npy("(1,)", "|O"), "pickled Python objects"),
    ],
)
def test_an_array_that_is_not_what_its_header_says(
    tmp_path: Path, little_memory: None, member: bytes, said: str
) -> None:
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("a.npy", member)
    assert said in refused(lambda: read_plain_npz(tmp_path / "a.npz"))


def test_an_archive_does_not_unpack_to_a_thousand_times_its_size(
    tmp_path: Path, little_memory: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("evsplat.untrusted.sizes._FREE_BYTES", 1 << 20)
    zeros = bytes(1 << 15)
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name in "ab":
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                member.write(npy("(9830400,)", "|u1"))
                for _ in range(300):
                    member.write(zeros)
    assert "that unpack to" in refused(lambda: read_plain_npz(tmp_path / "a.npz"))
    assert "that unpack to" in refused(lambda: read_npz(tmp_path / "a.npz"))


def test_a_packed_pickle_is_unpacked_up_to_a_plausible_size(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("evsplat.untrusted.sizes._FREE_BYTES", 1 << 16)
    plain = pickle.dumps(bytes(1 << 22))
    for pack in (gzip.compress, zlib.compress):
        (tmp_path / "a.pkl").write_bytes(pack(plain))
        assert "that unpack to" in refused(lambda: read_pickle(tmp_path / "a.pkl"))
    (tmp_path / "a.pkl").write_bytes(gzip.compress(pickle.dumps(bytes(1000))))
    assert read_pickle(tmp_path / "a.pkl") == bytes(1000)


def png(width: int, height: int) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(b"\0" * 99))


def test_pictures_that_are_programs_or_would_fill_the_memory(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n")
    assert "cannot be decoded as a picture" in refused(lambda: read_image(tmp_path / "a.png"))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)
        for size in ((12_000, 12_000), (60_000, 60_000)):
            (tmp_path / "a.png").write_bytes(png(*size))
            assert "make it smaller" in refused(lambda: read_image(tmp_path / "a.png"))


def test_a_playlist_is_no_video(tmp_path: Path) -> None:
    """FFmpeg would read the files and addresses that it names."""
    (tmp_path / "secret.ts").write_bytes(b"G" * 188)
    playlist = "#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\nsecret.ts\n#EXT-X-ENDLIST\n"
    (tmp_path / "a.mp4").write_text(playlist)
    assert "cannot be decoded as video" in refused(lambda: open_footage(tmp_path / "a.mp4"))


def write_events(path: Path, **columns: np.ndarray) -> None:
    t = np.arange(100) * 100
    right = {"t": t, "x": t % 4, "y": t % 3, "p": t % 2}
    with h5py.File(path, "w") as file:
        for name, values in (right | columns).items():
            if name in "txyp":
                file[f"events/{name}"] = values
        file["ms_to_idx"] = columns.get("ms_to_idx", np.arange(0, 110, 10))
        file["t_offset"] = columns.get("t_offset", np.int64(0))


@pytest.mark.parametrize(
    ("columns", "said"),
    [
        ({"x": np.zeros(99, int)}, "its columns differ in length"),
        ({"y": np.zeros((100, 1), int)}, "events/y has shape (100, 1) of int64"),
        ({"t_offset": np.zeros(3, int)}, "t_offset has shape (3,) of int64"),
        ({"t": np.arange(100.0)}, "events/t has shape (100,) of float64"),
        ({"p": np.full(100, 255)}, "has polarity 255"),
        ({"x": np.full(100, 65_537)}, "is at x=65537"),
        ({"ms_to_idx": np.full(11, 100)}, "is not the first event with t >= 2000"),
        ({"ms_to_idx": np.zeros(11, int)}, "is not the first event with t >="),
        ({"ms_to_idx": np.arange(0, 110, 10) + 1}, "is not the first event with t >="),
        ({"ms_to_idx": np.arange(2) * 10}, "is not the first event with t >="),
    ],
)
def test_event_files_that_other_readers_would_guess_at(
    tmp_path: Path, columns: dict[str, np.ndarray], said: str
) -> None:
    write_events(tmp_path / "a.h5")
    assert len(EventStore(tmp_path / "a.h5", 4, 4).between(2_000, 5_000)) == 30
    write_events(tmp_path / "b.h5", **columns)
    assert said in refused(lambda: EventStore(tmp_path / "b.h5", 4, 4).between(2_000, 5_000))


def test_event_files_name_no_other_file(tmp_path: Path, little_memory: None) -> None:
    write_events(tmp_path / "other.h5")
    for kind in ("link", "external", "virtual", "piece"):
        path = tmp_path / f"{kind}.h5"
        write_events(path)
        with h5py.File(path, "a") as file:
            del file["events/x"]
            if kind == "link":
                file["events/x"] = h5py.ExternalLink("other.h5", "/events/x")
            elif kind == "external":
                file.create_dataset("events/x", (100,), "i8", external=[("/etc/passwd", 0, 800)])
            elif kind == "virtual":
                layout = h5py.VirtualLayout((100,), "i8")
                layout[:] = h5py.VirtualSource(tmp_path / "other.h5", "events/x", (100,))
                file.create_virtual_dataset("events/x", layout)
            else:
                file.create_dataset("events/x", (100,), "i8", chunks=(1 << 26,), maxshape=(None,))
        said = refused(lambda: len(EventStore(path, 4, 4)))  # noqa: B023
        assert ("too large to be unpacked" if kind == "piece" else "of another file") in said


def test_a_damaged_index_of_an_hdf5_file_is_one_sentence(tmp_path: Path) -> None:
    path = tmp_path / "poses.hdf5"
    with h5py.File(path, "w") as file:
        file["pose"] = np.zeros((2, 72))
    content = bytearray(path.read_bytes())
    content[content.index(b"TREE") + 4] ^= 1  # the kind of its nodes
    path.write_bytes(content)

    def look() -> None:
        with open_hdf5(path) as file:
            holds(file, "pose")

    assert "pose: cannot be looked up" in refused(look)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (BVH.format(offset="0 0", time="0.1"), "not a readable BVH file"),
        (BVH.format(offset="0 0 1e300", time="0.1"), "an offset of 1e300"),
        (BVH.format(offset="0 nan 0", time="0.1"), "an offset of nan"),
        ("HIERARCHY ROOT a { OFFSET 0", "ends too early"),
        ("ROOT a " * 9, "several roots"),
    ],
)
def test_motions_that_are_cut_or_made_up(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "a.bvh").write_text(text)
    assert said in refused(lambda: load_motion(tmp_path / "a.bvh"))


def test_a_motion_of_many_joints_and_frames_is_refused_before_memory_is_taken(
    tmp_path: Path,
) -> None:
    joints = "".join(f"JOINT j{i} {{ OFFSET 0 1 0 CHANNELS 0 }} " for i in range(30_000))
    head = f"HIERARCHY ROOT a {{ OFFSET 0 0 0 CHANNELS 1 Xposition {joints} }} MOTION Frames: 3000 "
    (tmp_path / "a.bvh").write_text(head + "Frame Time: 0.1 " + "0 " * 3_000)
    assert "cut it into pieces" in refused(lambda: load_motion(tmp_path / "a.bvh"))


def test_poses_of_no_frame(tmp_path: Path) -> None:
    arrays = {"poses": np.zeros((0, 156)), "trans": np.zeros((0, 3)), "betas": np.zeros(16)}
    np.savez(tmp_path / "a.npz", **arrays, mocap_framerate=120.0)
    assert "poses is empty" in refused(lambda: read_poses(tmp_path / "a.npz"))


@pytest.mark.parametrize("value", ["1" + "0" * 400, "[1]", '"x"'])
def test_numbers_of_camera_paths(tmp_path: Path, value: str) -> None:
    keys = f'[{{"at": 0, "eye": [{value}, 0, 0], "target": [0, 0, 0], "up": [0, 0, 1]}}]'
    head = '{"format": "evsplat-camera-path", "version": 1, "width": 64, "height": 48, "keys": '
    (tmp_path / "a.json").write_text(head + keys.replace("}", ', "fov_y_deg": 40}') + "}")
    assert "keys[0].eye is" in refused(lambda: read_camera_path(tmp_path / "a.json"))


@pytest.mark.parametrize(
    ("assignment", "said"),
    [
        ("human.count=" + "9" * 4_000, "human.count is 999"),
        ("human.count=0x" + "f" * 9_000, "an integer of thousands of digits"),
        ("\0\n" + "x" * 5_000 + "=1", "unknown setting"),
        ("iterations=" + "x" * 5_000, "iterations is 'xxx"),
    ],
)
def test_settings_of_any_length_are_named_in_a_line(assignment: str, said: str) -> None:
    read = lambda: method_config("evsplat", override({}, [assignment]), where="--set")  # noqa: E731
    assert said in refused(read)


def test_a_method_is_a_name() -> None:
    for method in ([1], 3, None):
        said = refused(lambda: method_config(method, {}, where="a.yaml"))  # type: ignore[arg-type] # noqa: B023
        assert said == f"a.yaml: method is {method!r}; expected a name."


def test_weights_that_torch_cannot_read(tmp_path: Path) -> None:
    data = io.BytesIO()
    torch.save({"a": torch.zeros(100)}, data)
    (tmp_path / "a.pth").write_bytes(data.getvalue()[:500])
    assert "not a readable PyTorch weight file" in refused(lambda: read_state(tmp_path / "a.pth"))


@pytest.mark.parametrize(
    ("value", "said"),
    [
        ({"a": 1, "b": {"c": [1, 2.5]}}, ""),
        ({"a": True, "b": {"c": []}}, "a is True, expected a whole number"),
        ({"a": 1}, "it has no b"),
        ({"a": 1, "b": {"c": [1, None]}}, "b.c.1 is None, expected a number"),
        ({"a": 1, "b": []}, "b is [], expected an object"),
        ({"a": 10**400, "b": {}}, "a is 1000"),
        ([], "it is [], expected an object"),
    ],
)
def test_records_have_the_shape_that_they_were_written_in(value: object, said: str) -> None:
    found = misfit(value, {"a": int, "b": {str: [float]}})
    assert found.replace("'a'", "a").replace("'b'", "b").startswith(said) and bool(found) == bool(
        said
    )


def test_a_video_announces_no_more_than_8k(tmp_path: Path) -> None:
    head = b"GIF89a" + struct.pack("<HHBBB", 60_000, 60_000, 0xF0, 0, 0) + bytes(6)
    frame = b"," + struct.pack("<HHHHB", 0, 0, 60_000, 60_000, 0) + b"\x02\x02L\x01\0;"
    (tmp_path / "a.gif").write_bytes(head + frame)
    said = refused(lambda: list(open_footage(tmp_path / "a.gif")))
    assert "60000x60000 pixels" in said or "cannot be decoded" in said


def test_frames_of_key_points_have_names_of_any_length(tmp_path: Path) -> None:
    people = [{"image_id": "x" * 5_000, "keypoints": [0] * 51}] * 2
    (tmp_path / "a.json").write_text(json.dumps(people))
    assert "shows 2 people" in refused(lambda: read_keypoints(tmp_path / "a.json"))


def test_dense_poses_need_no_more_than_poses(tmp_path: Path) -> None:
    capture = write_tiny_capture(tmp_path / "tiny")
    with np.load(capture / "body.npz") as arrays:
        keyed = {key: arrays[key] for key in ("times_us", "poses", "transl")}
    np.savez(capture / "body_dense.npz", **keyed, joint_names=np.array("x"), betas=np.array("y"))
    assert len(load_body_track(load_capture(capture), dense=True).times_us) == 10
    np.savez(capture / "body_dense.npz", **keyed | {"transl": np.zeros((10, 3), np.uint8)})
    said = refused(lambda: load_body_track(load_capture(capture), dense=True))
    assert "body_dense.npz: transl: found 10x3 of uint8" in said


def test_tensors_are_read_whatever_bytes_the_name_of_their_folder_has(tmp_path: Path) -> None:
    folder = tmp_path / os.fsdecode(b"\xff")
    folder.mkdir()
    save_file({"a": torch.arange(3.0)}, tmp_path / "a.safetensors", {"text": "b"})
    (tmp_path / "a.safetensors").rename(folder / "a.safetensors")
    tensors, texts = read_safetensors(folder / "a.safetensors")
    assert torch.equal(tensors["a"], torch.arange(3.0)) and texts == {"text": "b"}


def test_ctrl_c_within_a_file_of_tensors_is_not_taken_for_damage(tmp_path: Path, monkeypatch):
    save_file({"a": torch.arange(3.0)}, tmp_path / "a.safetensors")
    part_of = torch.UntypedStorage.__getitem__

    def interrupted(storage: torch.UntypedStorage, part: slice | int) -> object:
        if isinstance(part, int):  # torch's own question, whose answer may only be an element
            os.kill(os.getpid(), signal.SIGINT)
        return part_of(storage, part)

    with monkeypatch.context() as patch:
        patch.setattr(torch.UntypedStorage, "__getitem__", interrupted)
        with pytest.raises(KeyboardInterrupt):
            read_safetensors(tmp_path / "a.safetensors")
    tensors, _ = read_safetensors(tmp_path / "a.safetensors")
    assert torch.equal(tensors["a"], torch.arange(3.0))
