"""The validator: one test per kind of fault; good captures have no findings."""

import json
import math
import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from PIL import Image

from evsplat.capture import Finding, load_capture, validate_capture
from evsplat.errors import DataError
from evsplat.pictures.files import read_image

from ..conftest import write_event_file

Factory = Callable[..., Path]


def edit_json(path: Path, *keys: Any, value: Any) -> None:
    """Set (or with ``...`` remove) a value of capture.json."""
    document = json.loads((path / "capture.json").read_text())
    inner = document
    for key in keys[:-1]:
        inner = inner[key]
    if value is ...:
        del inner[keys[-1]]
    else:
        inner[keys[-1]] = value
    (path / "capture.json").write_text(json.dumps(document))


def edit_body(path: Path, **changes: Any) -> None:
    with np.load(path / "body.npz") as arrays:
        body = {**arrays}
    for key, value in changes.items():
        if value is None:
            del body[key]
        else:
            body[key] = value(body[key].copy()) if callable(value) else value
    np.savez(path / "body.npz", **body)


def the_only(path: Path, severity: str = "error", **options: Any) -> Finding:
    findings = validate_capture(path, **options)
    assert len(findings) == 1, findings
    assert findings[0].severity == severity
    assert findings[0].found and findings[0].expected and findings[0].remedy
    return findings[0]


def check(finding: Finding, file: Path, field: str, found: str, expected: str) -> None:
    assert finding.file == file
    assert finding.field == field
    assert found in finding.found
    assert expected in finding.expected
    for part in (str(file), field, finding.found, finding.expected, finding.remedy):
        assert part in str(finding)


def refuses_to_load(path: Path) -> str:
    with pytest.raises(DataError) as error:
        load_capture(path)
    return str(error.value)


@pytest.mark.parametrize("seed", range(3))
def test_tiny_capture_has_no_findings(tiny_capture: Factory, seed: int) -> None:
    assert validate_capture(tiny_capture(seed=seed, frames=10 + seed)) == []


def test_demo_capture_has_no_findings(demo_capture_path: Path) -> None:
    assert validate_capture(demo_capture_path) == []


@pytest.mark.parametrize(
    "name",
    [
        "man_dance_hard_256",
        "woman_dance_b_256",
        "worker_punch_256",
        "real_beam_256",
        "real_beam_512",
    ],
)
def test_shared_captures_are_valid(captures_root: Path, name: str) -> None:
    findings = validate_capture(captures_root / name)
    # the real footage says itself that its exposures overlap
    assert [finding.field for finding in findings] == (
        ["frames[1].exposure_us"] if name.startswith("real") else []
    )
    assert all(finding.severity == "warning" for finding in findings)


# --- the faults that issue and README name ---------------------------------------------------


def test_missing_image(tiny_capture: Factory) -> None:
    path = tiny_capture()
    (path / "images/0004.png").unlink()
    finding = the_only(path)
    check(finding, path / "images/0004.png", "frames[4].image", "no such file", "a picture")
    assert "frame '0004'" in finding.found
    assert str(path / "images/0004.png") in refuses_to_load(path)


def test_body_without_pose_for_a_frame(tiny_capture: Factory) -> None:
    path = tiny_capture()
    edit_body(
        path, **{key: lambda a: np.delete(a, 5, 0) for key in ("times_us", "poses", "transl")}
    )
    finding = the_only(path)
    check(
        finding,
        path / "body.npz",
        "times_us",
        "no pose for frame '0005' at 215000 us",
        "15000..375000 us",
    )
    assert "frame '0005'" in refuses_to_load(path)


def test_poses_that_end_early_name_the_frames_left(tiny_capture: Factory) -> None:
    path = tiny_capture()
    edit_body(path, **{key: lambda a: a[:7] for key in ("times_us", "poses", "transl")})
    finding = the_only(path)
    check(finding, path / "body.npz", "times_us", "no pose for frame '0007'", "15000..255000 us")
    assert "2 more frames: 0008, 0009" in finding.found


def test_poses_at_another_rate_cover_the_frames(tiny_capture: Factory) -> None:
    path = tiny_capture()
    times = np.arange(0, 400_000, 33_333)
    poses, transl = np.zeros((len(times), 3, 3)), np.zeros((len(times), 3))
    edit_body(path, times_us=times, poses=poses, transl=transl)
    assert validate_capture(path) == []


def test_events_out_of_order(tiny_capture: Factory) -> None:
    path = tiny_capture()
    with h5py.File(path / "events.h5", "r+") as file:
        t = file["events/t"][:]
        late = np.flatnonzero(np.diff(t) > 0)[[20, 60]]
        t[late], t[late + 1] = t[late + 1], t[late].copy()
        file["events/t"][:] = t
        first, total = int(late[0]) + 1, len(t)
        by = int(t[late[0]] - t[late[0] + 1])
    finding = the_only(path)
    check(finding, path / "events.h5", f"events/t[{first}]", f"{by} us before", "ascending times")
    assert f"2 of {total} events" in finding.found
    assert f"events/t[{first}]" in refuses_to_load(path)


def test_wrong_resolution(tiny_capture: Factory) -> None:
    path = tiny_capture()
    Image.new("RGB", (30, 24)).save(path / "images/0001.png")
    finding = the_only(path)
    check(
        finding,
        path / "images/0001.png",
        "frames[1].image",
        "30x24 pixels",
        "32x24 pixels of camera 'main'",
    )
    assert "30x24" in refuses_to_load(path)


@pytest.mark.parametrize("version", [2, 0, "1", 1.5, None, True])
def test_unknown_version(tiny_capture: Factory, version: Any) -> None:
    path = tiny_capture()
    edit_json(path, "version", value=version)
    finding = the_only(path)
    check(finding, path / "capture.json", "version", repr(version), "1")
    assert "version" in refuses_to_load(path)


@pytest.mark.parametrize("keep", [0.2, 0.6, 0.98])
def test_truncated_hdf5(tiny_capture: Factory, keep: float) -> None:
    path = tiny_capture()
    whole = (path / "events.h5").read_bytes()
    (path / "events.h5").write_bytes(whole[: int(keep * len(whole))])
    finding = the_only(path)
    check(finding, path / "events.h5", "", "truncated", "a whole HDF5 file")
    assert "events.h5" in refuses_to_load(path)


def test_nan_pose(tiny_capture: Factory) -> None:
    path = tiny_capture()

    def spoil(poses: np.ndarray) -> np.ndarray:
        poses[3, 2, 1] = np.nan
        poses[4, 0, 0] = np.inf
        return poses

    edit_body(path, poses=spoil)
    finding = the_only(path)
    check(
        finding,
        path / "body.npz",
        "poses[3, 2, 1]",
        "nan in pose 3 at 135000 us, joint 2 'Arm'",
        "finite",
    )
    assert "2 such values" in finding.found
    assert "joint 2 'Arm'" in refuses_to_load(path)


def test_poses_in_degrees_are_refused_with_that_word(tiny_capture: Factory) -> None:
    path = tiny_capture()
    # The root of the small body sways and its arm swings by up to 52 degrees.
    edit_body(path, poses=np.degrees)
    check(the_only(path), path / "body.npz", "poses", "look like degrees", "in radians")
    assert "Multiply them by pi / 180" in refuses_to_load(path)


# --- capture.json --------------------------------------------------------------------------


def test_missing_folder_and_missing_or_broken_json(tmp_path: Path, tiny_capture: Factory) -> None:
    check(the_only(tmp_path / "no"), tmp_path / "no", "", "no such folder", "a capture folder")
    (tmp_path / "empty").mkdir()
    finding = the_only(tmp_path / "empty")
    check(finding, tmp_path / "empty/capture.json", "", "no such file", "capture's description")
    path = tiny_capture()
    (path / "capture.json").write_text('{"format": ')
    check(the_only(path), path / "capture.json", "", "not valid JSON", "JSON object")


def test_unknown_format(tiny_capture: Factory) -> None:
    path = tiny_capture()
    edit_json(path, "format", value="colmap")
    check(the_only(path), path / "capture.json", "format", "'colmap'", "'evsplat-capture'")


@pytest.mark.parametrize(
    "keys", [("format",), ("version",), ("body", "model"), ("frames", 2, "split")]
)
def test_what_is_found_fits_a_message(tiny_capture: Factory, keys: tuple) -> None:
    path = tiny_capture()
    edit_json(path, *keys, value="x" * 100_000)
    assert len(refuses_to_load(path)) < 1500


@pytest.mark.parametrize(
    ("keys", "field", "nearest"),
    [
        (("frame",), "frame", "frames"),
        (("frames", 2, "exposure"), "frames[2].exposure", "exposure_us"),
        (("cameras", "main", "k"), "cameras.main.k", "K"),
        (("events", "contrast_thresholds"), "events.contrast_thresholds", "contrast_threshold"),
    ],
)
def test_unknown_key_names_the_nearest(
    tiny_capture: Factory, keys: tuple, field: str, nearest: str
) -> None:
    path = tiny_capture()
    edit_json(path, *keys, value=1)
    finding = the_only(path, "warning")
    check(finding, path / "capture.json", field, "an unknown key", "a known key")
    assert repr(nearest) in finding.remedy
    load_capture(path)


@pytest.mark.parametrize(
    ("keys", "value", "field", "found", "expected"),
    [
        (("frames", 3, "exposure_us"), [5, 5], "frames[3].exposure_us", "empty", "start < end"),
        (("frames", 3, "exposure_us"), [9, 5], "frames[3].exposure_us", "negative", "start < end"),
        (("frames", 3, "exposure_us"), [0.5, 5], "frames[3].exposure_us", "0.5", "whole micro"),
        (("frames", 3, "exposure_us"), [10, 20], "frames[3].exposure_us", "not after", "in order"),
        (("frames", 3, "exposure_us"), "soon", "frames[3].exposure_us", "'soon'", "2 finite"),
        (("frames", 3, "split"), "val", "frames[3].split", "'val'", "'train' or 'test'"),
        (("frames", 3, "split"), ..., "frames", "9 of 10", "every frame or in none"),
        (("frames", 3, "name"), "0001", "frames[3].name", "'0001', already", "of its own"),
        (("frames", 3, "image"), ..., "frames[3].image", "nothing", "a value"),
        (("frames", 3, "camera"), "left", "frames[3].camera", "'left'", "'main', 'side'"),
        (("frames", 3), 7, "frames[3]", "7", "a JSON object"),
        (("frames",), [], "frames", "no frame", "at least one frame"),
        (("frames",), ..., "frames", "nothing", "a value"),
        (("cameras", "main", "width"), 0, "cameras.main.width", "0", "at least 1"),
        (("cameras", "side", "K"), [[1, 0], [0, 1]], "cameras.side.K", "[[1, 0]", "3x3 finite"),
        (("cameras", "side", "K", 0, 0), -5.0, "cameras.side.K", "-5.0", "fx and fy above 0"),
        (("cameras", "side", "K", 0, 1), 1.0, "cameras.side.K", "1.0", "[fx, 0, cx]"),
        (
            ("cameras", "side", "world_to_camera", 0),
            [2, 0, 0, 0],
            "cameras.side.world_to_camera",
            "not orthonormal",
            "a rotation",
        ),
        (
            ("cameras", "side", "world_to_camera", 3),
            [0, 0, 1, 1],
            "cameras.side.world_to_camera",
            "last row",
            "[0, 0, 0, 1]",
        ),
        (
            ("cameras", "side", "distortion"),
            {"model": "fisheye", "coefficients": [0, 0, 0, 0]},
            "cameras.side.distortion.model",
            "'fisheye'",
            "'opencv'",
        ),
        (
            ("cameras", "side", "distortion"),
            {"model": "opencv", "coefficients": [0.1, 0.2]},
            "cameras.side.distortion.coefficients",
            "[0.1, 0.2]",
            "4, 5 or 8",
        ),
        (("novel_views", 0, "frame"), "77", "novel_views[0].frame", "'77'", "of a frame"),
        (("novel_views", 0, "frame"), "0008", "novel_views[1].frame", "second view", "one view"),
        (("body", "model"), "star", "body.model", "'star'", "'rig'"),
        (
            ("cameras", "main", "transfer"),
            "gamma",
            "cameras.main.transfer",
            "'gamma'",
            "['power', 'srgb', 'linear']",
        ),
        (("body", "file"), ..., "body.file", "nothing", "a value"),
        (("body", "source"), "guess", "body.source", "'guess'", "['exact', 'markers', 'estimated'"),
        (("body", "source"), [1], "body.source", "[1]", "['exact', 'markers', 'estimated'"),
        (("body",), ..., "body", "nothing", "a value"),
        (("events", "width"), 31, "events.width", "31x24", "32x24 pixels of camera 'main'"),
        (
            ("events", "contrast_threshold"),
            [0.2, -0.2],
            "events.contrast_threshold",
            "-0.2",
            "positive",
        ),
        *(
            (("events", "contrast_threshold"), [c, c], "events.contrast_threshold", str(c), "0.001")
            for c in (1e-30, 1e6)
        ),
        *(
            (
                ("cameras", "main", "K", 0, 0),
                f,
                "cameras.main.K",
                f"{f:g}",
                "times the shorter",
            )
            for f in (1e-6, 1e9)
        ),
        (("cameras", "side", "width"), 20_000, "cameras.side.width", "20000", "at most 16384"),
        *(
            ((*keys, key), value, f"{field}.{key}", str(17 * 10**15), "up to 9.0072e+15")
            for keys, field, key, value in (
                (("frames", 3), "frames[3]", "exposure_us", [0, 17 * 10**15]),
                (("novel_views", 0), "novel_views[0]", "time_us", 17 * 10**15),
            )
        ),
        (("frames", 9, "exposure_us"), [360_000, 10**9], "frames[9].exposure_us", "", "a minute"),
        (("events", "clock_offset_us"), 1.5, "events.clock_offset_us", "1.5", "whole number"),
        (("events", "simulated"), "yes", "events.simulated", "'yes'", "true or false"),
    ],
)
def test_fault_of_the_description(
    tiny_capture: Factory, keys: tuple, value: Any, field: str, found: str, expected: str
) -> None:
    path = tiny_capture()
    edit_json(path, *keys, value=value)
    errors = [f for f in validate_capture(path) if f.severity == "error"]
    matching = [finding for finding in errors if finding.field == field]
    assert matching, errors
    check(matching[0], path / "capture.json", field, found, expected)
    message = refuses_to_load(path)
    assert str(path / "capture.json") in message


@pytest.mark.parametrize("camera", ["main", "side"])
def test_fault_of_a_camera_is_told_once_not_for_all_its_frames_and_views(
    tiny_capture: Factory, camera: str
) -> None:
    path = tiny_capture()
    edit_json(path, "cameras", camera, "K", 0, 0, value=-1.0)
    finding = the_only(path)
    check(finding, path / "capture.json", f"cameras.{camera}.K", "-1.0", "fx and fy above 0")


def test_mirrored_rotation(tiny_capture: Factory) -> None:
    path = tiny_capture()
    document = json.loads((path / "capture.json").read_text())
    row = [-v for v in document["cameras"]["main"]["world_to_camera"][0]]
    edit_json(path, "cameras", "main", "world_to_camera", 0, value=row)
    first = validate_capture(path)[0]
    assert first.field == "cameras.main.world_to_camera" and "mirrored" in first.found


def test_no_train_frame_is_an_error_and_no_test_frame_a_warning(tiny_capture: Factory) -> None:
    for split, severity in (("test", "error"), ("train", "warning")):
        path = tiny_capture(split)
        document = json.loads((path / "capture.json").read_text())
        for frame in document["frames"]:
            frame["split"] = split
        (path / "capture.json").write_text(json.dumps(document))
        finding = the_only(path, severity)
        assert finding.field == "frames" and "among 10" in finding.found


def test_overlapping_exposures_are_a_warning(tiny_capture: Factory) -> None:
    path = tiny_capture()
    edit_json(path, "frames", 4, "exposure_us", value=[140_000, 190_000])
    finding = the_only(path, "warning")
    field = "frames[4].exposure_us"
    check(finding, path / "capture.json", field, "1 exposure begun", "do not overlap")
    load_capture(path)


def test_exposures_as_long_as_the_interval_do_not_overlap_by_rounding(
    rng: np.random.Generator,
    tiny_capture: Factory,
) -> None:
    path = tiny_capture()
    fps = rng.uniform(20, 60)
    document = json.loads((path / "capture.json").read_text())
    shift = document["frames"][0]["exposure_us"][0]
    for index, frame in enumerate(document["frames"]):
        start, end = index * 1e6 / fps, (index + 1) * 1e6 / fps
        frame["exposure_us"] = [shift + math.floor(start), shift + math.ceil(end)]
    (path / "capture.json").write_text(json.dumps(document))
    found = validate_capture(path)
    assert not any("overlap" in finding.expected for finding in found)


def test_half_floats_are_compared_with_the_limit(
    tiny_capture: Factory, recwarn: pytest.WarningsRecorder
) -> None:
    path = tiny_capture()
    edit_body(path, poses=lambda poses: poses.astype(np.float16))
    assert validate_capture(path) == []
    edit_body(
        path,
        poses=lambda poses: (
            np.where(np.arange(poses.size) == 4, np.inf, poses.flat)
            .reshape(poses.shape)
            .astype(np.float16)
        ),
    )
    check(the_only(path), path / "body.npz", "poses[0, 1, 1]", "inf", "finite numbers up to 1e+06")
    assert not recwarn.list


@pytest.mark.parametrize(("factor", "unit"), [(1e-3, "milliseconds"), (1e3, "nanoseconds")])
def test_times_of_another_unit_are_a_warning(
    tiny_capture: Factory, factor: float, unit: str
) -> None:
    """The body is moved along and events are left out, which is told beside."""
    path = tiny_capture()
    document = json.loads((path / "capture.json").read_text())
    for frame in document["frames"]:
        frame["exposure_us"] = [round(time * factor) for time in frame["exposure_us"]]
    del document["events"], document["novel_views"]
    (path / "capture.json").write_text(json.dumps(document))
    with np.load(path / "body.npz") as body:
        times = (body["times_us"] * factor).astype(np.int64)
    edit_body(path, times_us=times)
    finding, other = validate_capture(path)
    assert other.field == "events" and finding.severity == "warning"
    check(
        finding,
        path / "capture.json",
        "frames[0].exposure_us",
        f"every {40_000 * factor:g} us",
        "500 to 10000000 us from one frame to the next",
    )
    assert unit in finding.remedy


def test_pictures_that_serve_twice_are_one_warning_with_their_number(tiny_capture: Factory) -> None:
    path = tiny_capture()
    frames = json.loads((path / "capture.json").read_text())["frames"]
    for index in range(3):
        edit_json(path, "frames", index, "image", value=frames[index]["sharp"])
    finding = the_only(path, "warning")
    assert "which frames[0].image names too (the first of 3 such pictures)" in finding.found
    assert finding.field == "frames[0].sharp"


def test_events_that_are_not_named_are_a_warning_and_a_video_alone_is_none(
    tiny_capture: Factory, caplog: pytest.LogCaptureFixture
) -> None:
    path = tiny_capture()
    edit_json(path, "events", value=...)
    assert the_only(path, "warning").field == "events"
    load_capture(path, warn=False)
    assert not caplog.messages
    assert load_capture(path).events is None
    assert [str(the_only(path, "warning"))] == caplog.messages
    (path / "events.h5").unlink()
    assert not validate_capture(path)


def test_first_error_is_raised_with_the_count_of_the_others(tiny_capture: Factory) -> None:
    path = tiny_capture()
    for name in ("0002", "0005", "0006"):
        (path / f"images/{name}.png").unlink()
    message = refuses_to_load(path)
    assert "images/0002.png" in message and "2 more errors" in message


# --- pictures ------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["masks", "sharp"])
def test_named_mask_or_truth_is_missing(tiny_capture: Factory, kind: str) -> None:
    path = tiny_capture()
    (path / kind / "0003.png").unlink()
    field = f"frames[3].{kind.removesuffix('s')}"
    check(the_only(path), path / kind / "0003.png", field, "no such file", "a picture")
    refuses_to_load(path)


@pytest.mark.parametrize(
    ("name", "field"),
    [
        ("masks/0003.png", "frames[3].mask"),
        ("sharp/0003.png", "frames[3].sharp"),
        ("novel/side/0008.png", "novel_views[1].image"),
    ],
)
def test_wrong_resolution_of_the_other_pictures(
    tiny_capture: Factory, name: str, field: str
) -> None:
    path = tiny_capture()
    Image.new("L", (32, 25)).save(path / name)
    check(the_only(path), path / name, field, "32x25 pixels", "32x24 pixels of camera")


def test_damaged_pixels_are_found_by_the_deep_check(tiny_capture: Factory) -> None:
    path = tiny_capture()
    whole = (path / "images/0006.png").read_bytes()
    (path / "images/0006.png").write_bytes(whole[: len(whole) // 2])
    check(
        the_only(path), path / "images/0006.png", "frames[6].image", "cannot be decoded", "readable"
    )
    (path / "images/0006.png").write_bytes(b"not a picture")
    assert "images/0006.png" in refuses_to_load(path)


def test_a_picture_too_large_to_be_decoded_is_refused(tiny_capture: Factory) -> None:
    """A PNG of a few bytes that says it has 900 million pixels."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    path = tiny_capture()
    header = struct.pack(">IIBBBBB", 30_000, 30_000, 8, 2, 0, 0, 0)
    parts = [chunk(b"IHDR", header), chunk(b"IDAT", zlib.compress(b"")), chunk(b"IEND", b"")]
    (path / "images/0006.png").write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(parts))
    for deep in (True, False):
        finding = the_only(path, deep=deep)
        place, field = path / "images/0006.png", "frames[6].image"
        check(finding, place, field, "900000000 pixels", "a readable picture")
        assert finding.remedy == "Make it smaller."
    assert "images/0006.png" in refuses_to_load(path)


def test_files_that_may_not_be_read_are_not_to_be_written_anew(
    tiny_capture: Factory, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tiny_capture()
    allowed = os.access
    for name in ("png", "npz", "h5"):
        # as the system says, which lets root read everything
        denied = lambda file, mode: not str(file).endswith(name) and allowed(file, mode)  # noqa: B023, E731
        with monkeypatch.context() as patch:
            patch.setattr(os, "access", denied)
            findings = validate_capture(path, deep=False)
        assert findings and all(finding.severity == "error" for finding in findings)
        for finding in findings:
            assert finding.remedy == "Give yourself the permission to read it.", name


def test_pairing_by_sort_order_is_noticed(tiny_capture: Factory) -> None:
    path = tiny_capture()
    edit_json(path, "frames", 5, "mask", value="masks/0004.png")
    findings = validate_capture(path)
    assert [(f.severity, f.field) for f in findings] == [("warning", "frames[5].mask")] * 2
    assert "frame '0004'" in findings[0].found and "by name" in findings[0].remedy
    assert "frames[4].mask" in findings[1].found


# --- body ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "field", "found", "expected"),
    [
        ({"poses": lambda a: a[:, :2]}, "poses", "10x2x3", "10x3x3"),
        ({"poses": lambda a: a[:9]}, "poses", "9x3x3", "10x3x3"),
        ({"transl": lambda a: a[:, :2]}, "transl", "10x2", "10x3"),
        ({"transl": None}, "transl", "nothing", "10x3"),
        ({"rest_joints": lambda a: a[:2]}, "rest_joints", "2x3", "3x3"),
        ({"weights": lambda a: a[:-1]}, "weights", "15x3", "16x3"),
        ({"weights": lambda a: a * 0.9}, "weights[0]", "a sum of 0.9", "sum to 1"),
        ({"weights": lambda a: np.where(a == 1, 2, -0.5)}, "weights[0]", "-0.5", "at least 0"),
        ({"parents": lambda a: a[::-1]}, "parents[0]", "1", "-1, the root"),
        ({"parents": np.array([-1, 2, 0])}, "parents[1]", "2", "a joint before it"),
        ({"parents": np.array([-1, -1, 0])}, "parents[1]", "-1", "a joint before it"),
        ({"faces": lambda a: a + 1}, "faces[14]", "16", "0..15"),
        ({"times_us": lambda a: a[::-1]}, "times_us[1]", "335000 after 375000", "ascending"),
        ({"times_us": lambda a: a / 1e6}, "times_us", "float64", "whole numbers"),
        ({"model": "smpl"}, "model", "'smpl'", "'rig'"),
        ({"model": None}, "model", "nothing", "'rig'"),
        ({"rest_vertices": None}, "rest_vertices", "nothing", "?x3"),
    ],
)
def test_fault_of_the_body(
    tiny_capture: Factory, changes: dict, field: str, found: str, expected: str
) -> None:
    path = tiny_capture()
    edit_body(path, **changes)
    matching = [finding for finding in validate_capture(path) if finding.field == field]
    assert len(matching) == 1 and matching[0].severity == "error"
    check(matching[0], path / "body.npz", field, found, expected)
    assert str(path / "body.npz") in refuses_to_load(path)


@pytest.mark.parametrize(
    ("source", "changes", "field", "found", "expected"),
    [
        ("markers", {"pose_std_rad": np.zeros((10, 2))}, "pose_std_rad", "10x2", "10x3"),
        ("markers", {"transl_std_m": np.zeros((9, 3))}, "transl_std_m", "9x3", "10x3"),
        ("markers", {"transl_std_m": None}, "transl_std_m", "nothing", "10x3"),
        ("markers", {"pose_std_rad": -0.1}, "pose_std_rad[0, 0]", "-0.1 (30", "at least 0"),
        ("markers", {"pose_std_rad": np.nan}, "pose_std_rad[0, 0]", "nan (30", "finite"),
        ("exact", {"transl_std_m": 0.1}, "transl_std_m[0, 0]", "0.1 (30", "0 of exact poses"),
        (None, {}, "pose_std_rad", "body.source of capture.json says nothing", "'markers'"),
    ],
)
def test_fault_of_the_errors_of_poses(
    tiny_capture: Factory,
    source: str | None,
    changes: dict,
    field: str,
    found: str,
    expected: str,
) -> None:
    path = tiny_capture()
    edit_json(path, "body", "source", value=source)
    stated: dict[str, Any] = {"pose_std_rad": np.zeros((10, 3)), "transl_std_m": np.zeros((10, 3))}
    for key, value in changes.items():
        stated[key] = np.full((10, 3), value) if isinstance(value, float) else value
    edit_body(path, **{key: value for key, value in stated.items() if value is not None})
    check(the_only(path), path / "body.npz", field, found, expected)


def test_a_person_far_from_the_origin_is_a_warning_that_says_how_to_come_near(
    tiny_capture: Factory,
) -> None:
    path = tiny_capture()
    before = load_capture(path)
    p = np.array([60_000.0, -80_000.0, 0.0])
    edit_body(path, transl=lambda a: a.astype(np.float64) + p)

    def moved(sign: int) -> None:
        cameras = json.loads((path / "capture.json").read_text())["cameras"]
        for name in cameras:
            pose = np.array(cameras[name]["world_to_camera"])
            pose[:3, 3] += sign * pose[:3, :3] @ p
            edit_json(path, "cameras", name, "world_to_camera", value=pose.tolist())

    moved(-1)
    finding = the_only(path, "warning")
    check(finding, path / "body.npz", "transl", "100,000 m from the origin", "within 300 m")
    assert "7.8 mm" in finding.found and "p = (60000, -80000, 0)" in finding.remedy
    # what the remedy says brings every camera back to where it saw the person before
    moved(+1)
    edit_body(path, transl=lambda a: a - p)
    assert not validate_capture(path)
    after = load_capture(path)
    for name, camera in before.cameras.items():
        difference = camera.world_to_camera - after.cameras[name].world_to_camera
        assert difference.abs().max() < 1e-6


@pytest.mark.parametrize("away_m", [0.0, 290.0])
def test_a_person_near_the_origin_is_not_told(tiny_capture: Factory, away_m: float) -> None:
    path = tiny_capture()
    edit_body(path, transl=lambda a: a * 0 + np.array([0.0, 0.0, away_m]))
    assert not validate_capture(path)


def test_infinite_translation_names_the_pose(tiny_capture: Factory) -> None:
    path = tiny_capture()

    def spoil(transl: np.ndarray) -> np.ndarray:
        transl[9, 2] = -np.inf
        return transl

    edit_body(path, transl=spoil)
    check(
        the_only(path), path / "body.npz", "transl[9, 2]", "-inf in pose 9 at 375000 us", "finite"
    )


@pytest.mark.parametrize("times", [[math.nan] * 10, ["soon"] * 10, [[0]]])
def test_a_pose_without_a_whole_time_is_named_by_its_place(tiny_capture: Factory, times) -> None:
    path = tiny_capture(frames=10)

    def spoil(poses: np.ndarray) -> np.ndarray:
        poses[3, 1] = np.nan
        return poses

    edit_body(path, poses=spoil, times_us=np.array(times))
    found = {finding.field: finding.found for finding in validate_capture(path)}
    assert "in pose 3, joint 1" in found["poses[3, 1, 0]"] and "times_us" in found


def test_pickled_objects_are_refused_and_not_run(tiny_capture: Factory) -> None:
    path = tiny_capture()
    edit_body(path, joint_names=np.array(["Hips", "Chest", None], dtype=object))
    check(the_only(path), path / "body.npz", "", "pickled Python objects", "plain arrays")
    assert "pickled" in refuses_to_load(path)


def test_missing_and_damaged_body(tiny_capture: Factory) -> None:
    path = tiny_capture()
    whole = (path / "body.npz").read_bytes()
    (path / "body.npz").write_bytes(whole[: len(whole) // 2])
    check(the_only(path), path / "body.npz", "", "not a readable npz", "an npz")
    (path / "body.npz").unlink()
    check(the_only(path), path / "body.npz", "", "no such file", "the body")


def test_faults_of_dense_poses_are_found_by_the_deep_check(tiny_capture: Factory) -> None:
    path = tiny_capture()
    times = np.arange(20)
    np.savez(
        path / "body_dense.npz",
        times_us=times,
        poses=np.zeros((20, 4, 3)),
        transl=np.zeros((20, 3)),
    )
    check(the_only(path), path / "body_dense.npz", "poses", "20x4x3", "20x3x3")
    assert validate_capture(path, deep=False) == []


def test_parametric_bodies_need_their_shape(tiny_capture: Factory) -> None:
    path = tiny_capture()
    edit_json(path, "body", "model", value="smpl")
    edit_body(path, model="smpl", poses=np.zeros((10, 24, 3)), betas=np.zeros(10), gender="female")
    assert validate_capture(path) == []
    edit_body(path, betas=None, gender="other")
    assert [f.field for f in validate_capture(path)] == ["betas", "gender"]


# --- events --------------------------------------------------------------------------------


def edit_events(path: Path, key: str, change: Callable[[np.ndarray], Any] | None) -> None:
    with h5py.File(path / "events.h5", "r+") as file:
        values = file[key][()]
        del file[key]
        if change is not None:
            file[key] = change(values)


def set_at(index: int, value: int) -> Callable[[np.ndarray], np.ndarray]:
    def change(values: np.ndarray) -> np.ndarray:
        values[index] = value
        return values

    return change


@pytest.mark.parametrize(
    ("key", "change", "field", "found", "expected"),
    [
        ("events/x", set_at(30, 32), "events/x[30]", "32 (1 of", "below 32"),
        ("events/y", set_at(40, 999), "events/y[40]", "999 (1 of", "below 24"),
        ("events/p", set_at(50, 2), "events/p[50]", "2 (1 of", "0 (darker) or 1"),
        ("ms_to_idx", set_at(100, 7), "ms_to_idx[100]", "7", "t >= 100000"),
        ("ms_to_idx", lambda a: a + (a > a.mean()), "ms_to_idx[206]", "", "first event"),
        ("ms_to_idx", lambda a: a * 0 + a.max(), "ms_to_idx[0]", "", "t >= 0"),
        ("ms_to_idx", lambda a: a + 1, "ms_to_idx[0]", "1", "t >= 0"),
        ("ms_to_idx", None, "ms_to_idx", "nothing", "a data set"),
        ("t_offset", None, "t_offset", "nothing", "a data set"),
        ("events/p", None, "events/p", "nothing", "a data set"),
        ("events/y", lambda a: a[:-1], "events", "events/y (", "equally long"),
        ("events/t", lambda a: a * 1e-6, "events/t", "float64", "int64"),
        ("t_offset", lambda a: a + 10**9, "events/t", "events from 1000", "over 0..390000"),
    ],
)
def test_fault_of_the_events(
    tiny_capture: Factory, key: str, change: Any, field: str, found: str, expected: str
) -> None:
    path = tiny_capture()
    edit_events(path, key, change)
    check(the_only(path), path / "events.h5", field, found, expected)
    assert "events.h5" in refuses_to_load(path)


@pytest.mark.parametrize("name", ["events/p", "events", "ms_to_idx", "t_offset"])
@pytest.mark.parametrize("kind", ["to itself", "to nothing", "empty"])
def test_links_in_the_event_file_that_lead_nowhere_are_no_data_sets(
    tiny_capture: Factory, name: str, kind: str
) -> None:
    path = tiny_capture()
    with h5py.File(path / "events.h5", "r+") as file:
        del file[name]
        if kind == "empty":
            file[name] = h5py.Empty("i8")
        else:
            file[name] = h5py.SoftLink(f"/{name}" if kind == "to itself" else "/nowhere")
    findings = validate_capture(path, deep=False)
    assert len(findings) == (4 if name == "events" else 1)
    for finding in findings:
        assert finding.severity == "error" and finding.field.startswith(name)
        found = "what HDF5 cannot open" if kind == "to itself" else "nothing"
        assert finding.found.startswith(found) and finding.expected == "a data set"
    assert "events.h5" in refuses_to_load(path)


@pytest.mark.parametrize("column", ["events/t", "events/x", "events/y", "events/p"])
def test_columns_without_a_sign_are_to_be_converted_and_no_broken_file(
    tiny_capture: Factory, column: str
) -> None:
    path = tiny_capture()
    edit_events(path, column, lambda values: values.astype(np.uint64))
    finding = the_only(path, "warning", deep=True)
    check(finding, path / "events.h5", column, "uint64", "int")
    load_capture(path)


def test_index_must_reach_the_last_event_and_hold_beyond_it(tiny_capture: Factory) -> None:
    path = tiny_capture()
    with h5py.File(path / "events.h5") as file:
        total, last_ms = len(file["events/t"]), int(file["events/t"][-1]) // 1000
    edit_events(path, "ms_to_idx", set_at(-1, 0))
    finding = the_only(path)
    check(finding, path / "events.h5", f"ms_to_idx[{last_ms + 1}]", "0", f"{total}, the first")
    edit_events(path, "ms_to_idx", lambda index: index[:50])
    finding = the_only(path)
    check(finding, path / "events.h5", "ms_to_idx", "50 milli", f"at least {last_ms + 1}, one")


def test_fault_of_the_events_entry_is_not_told_as_its_absence_too(tiny_capture: Factory) -> None:
    path = tiny_capture()
    edit_json(path, "events", "clock_offset_us", value=2**62)
    check(the_only(path), path / "capture.json", "events.clock_offset_us", "46116", "up to 9.0072")


def test_times_since_1970_are_to_be_put_into_the_offset(tiny_capture: Factory) -> None:
    """Rebuilding the index, as is right otherwise, would take hours and a disk of its own."""
    path = tiny_capture()
    edit_events(path, "events/t", lambda t: t + 1_700_000_000_000_000)
    edit_events(path, "t_offset", lambda offset: offset - 1_700_000_000_000_000)
    edit_events(path, "ms_to_idx", np.zeros_like)
    finding = the_only(path)
    check(finding, path / "events.h5", "ms_to_idx", "milliseconds", "at least 1700000000")
    assert finding.remedy.startswith("Subtract 17000000000") and "t_offset" in finding.remedy


@pytest.mark.parametrize("deep", [False, True])
def test_times_before_zero_are_no_fault(
    tiny_capture: Factory, monkeypatch: pytest.MonkeyPatch, deep: bool
) -> None:
    monkeypatch.setattr("evsplat.capture.check_events._SHORT", 0)
    path = tiny_capture()
    edit_events(path, "events/t", lambda t: t - 1_000_000)
    edit_events(path, "t_offset", lambda offset: offset + 1_000_000)
    with h5py.File(path / "events.h5") as file:
        count = len(file["events/t"])
    edit_events(path, "ms_to_idx", lambda index: np.full(1, count, index.dtype))
    assert validate_capture(path, deep=deep) == []


def test_negative_polarity_is_not_brighter(tiny_capture: Factory) -> None:
    path = tiny_capture()
    edit_events(path, "events/p", lambda p: 2 * p.astype(np.int8) - 1)
    findings = {finding.severity: finding for finding in validate_capture(path)}
    assert findings["warning"].field == "events/p" and findings["warning"].found == "int8"
    assert "-1" in findings["error"].found


def test_faults_beyond_the_first_piece_of_the_scan(
    tiny_capture: Factory, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The scan goes in pieces; order and index must hold across their borders."""
    path = tiny_capture()
    for piece in (1, 7, 64, 100):
        monkeypatch.setattr("evsplat.capture.check_events._SCAN_EVENTS", piece)
        assert validate_capture(path) == []
    with h5py.File(path / "events.h5", "r+") as file:
        file["events/t"][128] = file["events/t"][127] - 1
    monkeypatch.setattr("evsplat.capture.check_events._SCAN_EVENTS", 64)
    assert the_only(path).field == "events/t[128]"


def test_damaged_chunk_is_found_by_the_deep_check(tiny_capture: Factory) -> None:
    path = tiny_capture()
    with h5py.File(path / "events.h5") as file:
        chunk = file["events/t"].id.get_chunk_info(0)
    raw = bytearray((path / "events.h5").read_bytes())
    for at in range(chunk.byte_offset + 10, chunk.byte_offset + chunk.size - 10):
        raw[at] ^= 0x5A
    (path / "events.h5").write_bytes(raw)
    fields = [finding for finding in validate_capture(path) if finding.severity == "error"]
    assert any("cannot be read" in f.found or "HDF5 cannot read" in f.found for f in fields)


def test_missing_event_file(tiny_capture: Factory) -> None:
    path = tiny_capture()
    (path / "events.h5").unlink()
    check(the_only(path), path / "events.h5", "", "no such file", "the event recording")


def test_events_that_cover_only_a_part_are_a_warning(tiny_capture: Factory) -> None:
    path = tiny_capture()
    edit_json(path, "events", "clock_offset_us", value=120_000)
    finding = the_only(path, "warning")
    check(finding, path / "events.h5", "events/t", "events from 12", "over 0..390000 us")
    assert "clock_offset_us" in finding.remedy


@pytest.mark.parametrize("ends", [("first",), ("last",), ("first", "last")])
def test_events_that_no_clock_offset_makes_long_enough_say_so(
    tiny_capture: Factory, ends: tuple[str, ...]
) -> None:
    """Of a sensor that was switched on later and off earlier no offset is the remedy."""
    path = tiny_capture(frames=10, width=64, height=48)
    with h5py.File(path / "events.h5") as file:
        t, x, y, p = (file[f"events/{key}"][:] for key in "txyp")
    kept = (t >= 120_000 * ("first" in ends)) & (t < (240_000 if "last" in ends else t[-1] + 1))
    write_event_file(path / "events.h5", *(column[kept] for column in (t, x, y, p)))
    finding = the_only(path, "warning")
    check(finding, path / "events.h5", "events/t", "events from", "over 0..")
    assert "They last shorter than the frames, whatever their clock" in finding.remedy
    assert "beside them, these are learned from their blur alone." in finding.remedy


def test_no_test_frame_says_how_to_have_one(tiny_capture: Factory) -> None:
    path = tiny_capture()
    edit_json(path, "frames", value=[
        {key: value for key, value in frame.items() if key != "split"}
        for frame in json.loads((path / "capture.json").read_text())["frames"][:5]
    ])  # fmt: skip
    finding = next(item for item in validate_capture(path) if "no test frame" in item.found)
    assert finding.severity == "warning" and finding.field == "frames"
    assert "give every frame a split" in finding.remedy and "7, 8 and 9" in finding.remedy


@pytest.mark.parametrize("end", ["first", "last"])
@pytest.mark.parametrize("noise", [0, 2])
def test_a_sensor_that_is_silent_while_nothing_moves_is_no_fault(
    rng: np.random.Generator, tiny_capture: Factory, end: str, noise: int
) -> None:
    """Somebody enters in the fifth frame, or left before it; the camera has noise or has none.

    Where they move in the other frames as well, events of those were lost, or have another clock.
    """
    path = tiny_capture(frames=10, width=64, height=48)
    still = range(4) if end == "first" else range(4, 10)
    with h5py.File(path / "events.h5") as file:
        t, x, y, p = (file[f"events/{key}"][:] for key in "txyp")
    kept = t >= 160_000 if end == "first" else t < 160_000
    write_event_file(path / "events.h5", *(column[kept] for column in (t, x, y, p)))
    check(the_only(path, "warning"), path / "events.h5", "events/t", "events from", "over 0..")
    empty = read_image(path / "images" / f"{still[0]:04d}.png").astype(int)
    for index in still:
        picture = empty + rng.normal(0, noise, empty.shape).round().astype(int)
        name = path / "images" / f"{index:04d}.png"
        Image.fromarray(picture.clip(0, 255).astype(np.uint8)).save(name)
    assert validate_capture(path, deep=False) == []


# --- anything ------------------------------------------------------------------------------

JUNK = [None, True, -1, 0.5, 1e300, 10**400, "", "x", "\0", [], {}, [None], [[1], [2, 3]], {"a": 1}]


@pytest.mark.parametrize("seed", range(5))
def test_junk_anywhere_in_the_description_never_crashes(tiny_capture: Factory, seed: int) -> None:
    path = tiny_capture()
    original = json.loads((path / "capture.json").read_text())
    places = list(_places(original))
    rng = np.random.default_rng(seed)
    for _ in range(25):
        place = places[rng.integers(len(places))]
        (path / "capture.json").write_text(json.dumps(original))
        edit_json(path, *place, value=JUNK[rng.integers(len(JUNK))])
        for finding in validate_capture(path, deep=False):
            assert finding.found and finding.expected and finding.remedy


def _places(node: Any, keys: tuple = ()) -> Any:
    """The path of every value in a JSON document."""
    children = node.items() if isinstance(node, dict) else enumerate(node)
    for key, child in children:
        yield (*keys, key)
        if isinstance(child, (dict, list)):
            yield from _places(child, (*keys, key))
