"""capture.json: from JSON to `Metadata`, every fault noted."""

from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from evsplat.body.pose_errors import POSE_SOURCES, PoseSource
from evsplat.camera import Camera
from evsplat.capture.distortion import COEFFICIENT_COUNTS, Distortion
from evsplat.capture.fields import MISSING, RENAME, Fields, is_whole
from evsplat.capture.finding import Findings, reason_and_remedy
from evsplat.capture.metadata import EventsEntry, Frame, Metadata, NovelView
from evsplat.errors import DataError
from evsplat.names import NAME_RULE, is_name
from evsplat.options.inputs import no_capture
from evsplat.pictures.light import TRANSFERS, Transfer
from evsplat.untrusted.faults import brief
from evsplat.untrusted.text import read_json

FORMAT = "evsplat-capture"
VERSION = 1
BODY_MODELS = ("rig", "default", "smpl", "smplh", "smplx")
# Rotations written as rounded decimals are accepted down to about five digits.
_ROTATION_TOLERANCE = 1e-4
# Training and evaluation compare pictures by SSIM, whose window has this side.
_SMALLEST_PX = 11
_LARGEST_PX = 16_384
# Sensors have thresholds of 0.1 to 0.6; simulations may go further.
_THRESHOLDS = (1e-3, 10.0)
# From a fish eye's middle to a telescope.
_FOCAL_IN_SIDES = (0.05, 200.0)
_LONGEST_EXPOSURE_US = 60_000_000


def read_metadata(path: Path, findings: Findings) -> Metadata | None:
    """Read ``path``/capture.json; faults go to ``findings``.

    None where the file as a whole cannot be used; entries with errors are left out otherwise.
    """
    file = path / "capture.json"
    if missing := no_capture(path):
        where, found, expected, remedy = missing
        findings.error(where, "", found, expected, remedy)
        return None
    try:
        document = read_json(file)
    except DataError as error:
        reason, remedy = reason_and_remedy(error, file)
        remedy = remedy or "Is this a capture folder?"
        expected = "the capture's description as a JSON object"
        findings.error(file, "", reason, expected, remedy)
        return None
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        found = repr(document.get("format")) if isinstance(document, dict) else "no JSON object"
        findings.error(file, "format", found, repr(FORMAT), "Import the recording as a capture.")
        return None
    if document.get("version") != VERSION or isinstance(document.get("version"), bool):
        findings.error(
            file,
            "version",
            repr(document.get("version")),
            str(VERSION),
            "This evsplat reads version 1: update evsplat or convert the capture.",
        )
        return None
    return _Parser(path, file, findings).parse(document)


class _Parser:
    """Turns the JSON of one capture into `Metadata`."""

    def __init__(self, path: Path, file: Path, findings: Findings) -> None:
        self.path, self.file, self.findings = path, file, findings

    def parse(self, document: dict[str, Any]) -> Metadata:
        known = ("format", "version", "name", "cameras", "frames", "novel_views", "body", "events")
        top = self.fields("", document, (*known, "provenance"))
        cameras, distortions, transfers = self.cameras(top)
        frames = self.frames(top, cameras)
        body = self.body(top)
        provenance = document.get("provenance", {})
        body_file = body.path("file", self.path) if body else None
        return Metadata(
            path=self.path,
            name=top.name("name"),
            cameras=cameras,
            distortions=distortions,
            transfers=transfers,
            frames=frames,
            novel_views=self.novel_views(top, cameras, frames),
            body_file=body_file or self.path / "body.npz",
            body_model=self.body_model(body) if body else "",
            body_source=self.body_source(body) if body else None,
            events=self.events(document),
            provenance=provenance if isinstance(provenance, dict) else {"text": str(provenance)},
        )

    def fields(self, where: str, value: Any, known: tuple[str, ...]) -> Fields:
        return Fields(self.file, where, value, known, self.findings)

    def cameras(
        self, top: Fields
    ) -> tuple[dict[str, Camera], dict[str, Distortion], dict[str, Transfer]]:
        cameras: dict[str, Camera] = {}
        distortions: dict[str, Distortion] = {}
        transfers: dict[str, Transfer] = {}
        entries = top.get("cameras")
        if not isinstance(entries, dict) or not entries:
            if entries is not None:
                top.fail("cameras", brief(entries), "at least one named camera", "Add a camera.")
            return cameras, distortions, transfers
        keys = ("width", "height", "K", "world_to_camera", "distortion", "transfer")
        for name, value in entries.items():
            if not is_name(name):
                top.fail("cameras", brief(name), f"names: {NAME_RULE}", RENAME)
                continue
            entry = self.fields(f"cameras.{name}", value, keys)
            width, height = self.pixels(entry, "width"), self.pixels(entry, "height")
            K, pose = self.intrinsics(entry, width, height), self.rigid(entry, "world_to_camera")
            coefficients, transfer = self.distortion(entry), self.transfer(entry)
            if not entry.valid or K is None or pose is None:
                continue
            K32 = torch.from_numpy(K.astype(np.float32))
            cameras[name] = Camera(width, height, K32, pose)
            if coefficients and any(coefficients):
                distortions[name] = Distortion(width, height, K, coefficients)
            if transfer is not None:
                transfers[name] = transfer
        return cameras, distortions, transfers

    def pixels(self, entry: Fields, key: str) -> int:
        """A side of the camera's pictures."""
        count = entry.integer(key, minimum=1)
        if count > _LARGEST_PX:
            entry.fail(key, f"{count} pixels", f"at most {_LARGEST_PX}", "Shrink the pictures.")
        if 0 < count < _SMALLEST_PX:
            entry.fail(
                key,
                f"{count} pixels",
                f"at least {_SMALLEST_PX}, the side of SSIM's window",
                "Record larger pictures, or shrink them less.",
            )
        return count

    def intrinsics(self, entry: Fields, width: int, height: int) -> np.ndarray | None:
        K = entry.numbers("K", (3, 3))
        if K is None:
            return None
        pinhole = K[0, 0] > 0 and K[1, 1] > 0 and K[0, 1] == 0 and K[1, 0] == 0
        if not pinhole or K[2].tolist() != [0, 0, 1]:
            entry.fail(
                "K",
                brief(K.tolist()),
                "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels with fx and fy above 0",
                "Give the camera's intrinsics (no skew).",
            )
            return None
        (low, high), focal = _FOCAL_IN_SIDES, K[[0, 1], [0, 1]]
        shorter, longer = min(width, height), max(width, height)
        if shorter > 0 and not ((focal >= low * shorter) & (focal <= high * longer)).all():
            entry.fail(
                "K",
                f"focal lengths of {focal[0]:g} and {focal[1]:g} pixels",
                f"{low:g} times the shorter to {high:g} times the longer side of {width}x{height}",
                "Give the focal length in pixels: that in millimetres over a pixel's size.",
            )
            return None
        return K

    def rigid(self, entry: Fields, key: str, default: Any = MISSING) -> Tensor | None:
        matrix = entry.numbers(key, (4, 4), default)
        if matrix is None:
            return None
        rotation = matrix[:3, :3]
        error = np.abs(rotation @ rotation.T - np.eye(3)).max()
        if error > _ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
            kind = (
                "a mirrored rotation"
                if error <= _ROTATION_TOLERANCE
                else (f"a rotation part that is not orthonormal (off by {error:.2g})")
            )
            entry.fail(key, kind, "a rotation and a translation", "Give the 4x4 world to camera.")
            return None
        if matrix[3].tolist() != [0, 0, 0, 1]:
            entry.fail(key, f"last row {matrix[3].tolist()}", "[0, 0, 0, 1]", "Transpose it?")
            return None
        return torch.from_numpy(matrix.astype(np.float32))

    def distortion(self, entry: Fields) -> tuple[float, ...] | None:
        value = entry.get("distortion", None)
        if value is None:
            return None
        inner = self.fields(f"{entry.where}.distortion", value, ("model", "coefficients"))
        if inner.valid and inner.text("model") != "opencv":
            inner.fail("model", brief(inner.value.get("model")), "'opencv'", "Undistort first.")
        coefficients = inner.entries("coefficients")
        numeric = all(isinstance(c, (int, float)) and abs(c) < 1e9 for c in coefficients)
        if inner.valid and (len(coefficients) not in COEFFICIENT_COUNTS or not numeric):
            inner.fail(
                "coefficients",
                brief(coefficients),
                "4, 5 or 8 numbers: k1, k2, p1, p2, k3, k4, k5, k6",
                "Give OpenCV's coefficients or null.",
            )
        entry.valid &= inner.valid
        return tuple(float(c) for c in coefficients) if inner.valid else None

    def transfer(self, entry: Fields) -> Transfer | None:
        value = entry.get("transfer", None)
        if value is None or value in TRANSFERS:
            return value
        entry.fail("transfer", brief(value), f"one of {list(TRANSFERS)}", "Correct it.")
        return None

    def frames(self, top: Fields, cameras: dict[str, Camera]) -> tuple[Frame, ...]:
        entries = top.entries("frames")
        if not entries:
            if "frames" in top.value:
                top.fail("frames", "no frame", "at least one frame", "Add the recorded frames.")
            return ()
        with_split = sum(isinstance(value, dict) and "split" in value for value in entries)
        if with_split not in (0, len(entries)):
            top.fail(
                "frames",
                f"'split' in {with_split} of {len(entries)} frames",
                "a split in every frame or in none",
                "Name 'train' or 'test' for each, or leave all out (index mod 10 in 7, 8, 9 is "
                "test then).",
            )
        frames = []
        for index, value in enumerate(entries):
            frame = self.frame(index, value, cameras)
            entries[index] = None  # an hour's are 25 MB, whose room the frames can take
            if frame is not None:
                frames.append(frame)
        self.check_frames(frames)
        return tuple(frames)

    def frame(self, index: int, value: Any, cameras: dict[str, Camera]) -> Frame | None:
        keys = ("name", "camera", "image", "exposure_us", "split", "sharp", "mask")
        entry = self.fields(f"frames[{index}]", value, (*keys, "world_to_camera"))
        name, camera = entry.name("name"), entry.text("camera")
        self.check_camera(entry, camera, cameras)
        image = entry.path("image", self.path)
        exposure = self.exposure(entry)
        split = entry.text("split", default_split(index))
        if entry.valid and split not in ("train", "test"):
            entry.fail("split", repr(split), "'train' or 'test'", "Correct it.")
        sharp = entry.path("sharp", self.path, required=False)
        mask = entry.path("mask", self.path, required=False)
        pose = self.rigid(entry, "world_to_camera", None)
        if not entry.valid or image is None or exposure is None:
            return None
        kind: Literal["train", "test"] = "train" if split == "train" else "test"
        return Frame(name, index, camera, image, exposure, kind, sharp, mask, pose)

    def check_camera(self, entry: Fields, camera: str, cameras: dict[str, Camera]) -> None:
        declared = entry.valid and camera in cameras
        if entry.valid and not declared:
            entry.fail(
                "camera",
                repr(camera),
                f"one of the valid cameras {sorted(cameras)}",
                "Correct the name or the camera's entry.",
            )

    def exposure(self, entry: Fields) -> tuple[int, int] | None:
        pair = entry.numbers("exposure_us", (2,))
        if pair is None:
            return None
        if not all(is_whole(value) for value in pair.tolist()):
            entry.fail("exposure_us", str(pair.tolist()), "whole microseconds", "Round them.")
            return None
        start, end = int(pair[0]), int(pair[1])
        if end <= start:
            kind = "an empty exposure" if end == start else "a negative exposure"
            entry.fail(
                "exposure_us",
                f"{kind} [{start}, {end}]",
                "[start, end] with start < end in microseconds",
                "Give the times when the shutter opened and closed.",
            )
            return None
        if end - start > _LONGEST_EXPOSURE_US:
            entry.fail(
                "exposure_us",
                f"{end - start} us",
                f"at most {_LONGEST_EXPOSURE_US}, a minute",
                "Give times in microseconds.",
            )
            return None
        return start, end

    def check_frames(self, frames: list[Frame]) -> None:
        """Findings that need all frames together: names, order, overlap, splits."""
        first_of: dict[str, int] = {}
        last_of: dict[str, Frame] = {}
        overlaps = []
        for frame in frames:
            where = f"frames[{frame.index}]"
            if frame.name in first_of:
                self.findings.error(
                    self.file,
                    f"{where}.name",
                    f"{frame.name!r}, already the name of frames[{first_of[frame.name]}]",
                    "a name of its own for each frame",
                    "Rename one of the two.",
                )
            first_of.setdefault(frame.name, frame.index)
            before = last_of.get(frame.camera)
            last_of[frame.camera] = frame
            if before is None:
                continue
            if frame.exposure_us[0] <= before.exposure_us[0]:
                self.findings.error(
                    self.file,
                    f"{where}.exposure_us",
                    f"a start of {frame.exposure_us[0]}, not after {before.exposure_us[0]} of "
                    f"frame {before.name!r}",
                    "frames of a camera in order of time",
                    "Sort the frames, or correct the exposure.",
                )
            elif frame.exposure_us[0] < before.exposure_us[1]:
                overlaps.append(frame)
        if overlaps:
            self.findings.warning(
                self.file,
                f"frames[{overlaps[0].index}].exposure_us",
                f"{len(overlaps)} exposures that begin before the one before ends "
                f"(first: frame {overlaps[0].name!r})",
                "exposures that do not overlap",
                "Check the exposure time; a sharp moment is then seen by two frames.",
            )
        for split, note in (("train", self.findings.error), ("test", self.findings.warning)):
            if frames and not any(frame.split == split for frame in frames):
                note(
                    self.file,
                    "frames",
                    f"no {split} frame among {len(frames)}",
                    f"at least one frame with split {split!r}",
                    "Change the split of some frames.",
                )

    def novel_views(
        self, top: Fields, cameras: dict[str, Camera], frames: tuple[Frame, ...]
    ) -> tuple[NovelView, ...]:
        names = {frame.name for frame in frames}
        views: list[NovelView] = []
        seen: set[tuple[str, str]] = set()
        for index, value in enumerate(top.entries("novel_views", [])):
            keys = ("camera", "frame", "time_us", "image")
            entry = self.fields(f"novel_views[{index}]", value, keys)
            camera, frame = entry.text("camera"), entry.text("frame")
            self.check_camera(entry, camera, cameras)
            time_us, image = entry.integer("time_us"), entry.path("image", self.path)
            if entry.valid and frame not in names:
                entry.fail("frame", repr(frame), "the name of a valid frame", "Correct it.")
            if entry.valid and (camera, frame) in seen:
                entry.fail(
                    "frame",
                    f"a second view of camera {camera!r} at frame {frame!r}",
                    "one view per camera and frame",
                    "Remove one.",
                )
            seen.add((camera, frame))
            if entry.valid and image is not None:
                views.append(NovelView(index, camera, frame, time_us, image))
        return tuple(views)

    def body(self, top: Fields) -> Fields | None:
        if "body" in top.value and top.value["body"] is None:
            self.findings.warning(
                self.file,
                "body",
                "null: no body",
                "a body and its poses",
                "All methods need them; 'evsplat poses' finds them.",
            )
            return None
        keys = ("file", "model", "source")
        return self.fields("body", top.get("body"), keys) if top.has("body") else None

    def body_model(self, body: Fields) -> str:
        model = body.text("model")
        if body.valid and model not in BODY_MODELS:
            body.fail("model", repr(model), f"one of {list(BODY_MODELS)}", "Correct it.")
        return model

    def body_source(self, body: Fields) -> PoseSource | None:
        source = body.get("source", None)
        if source is None or source in POSE_SOURCES:
            return source
        body.fail("source", brief(source), f"one of {list(POSE_SOURCES)}", "Correct it.")
        return None

    def events(self, document: dict[str, Any]) -> EventsEntry | None:
        value = document.get("events")
        if value is None:
            self.findings.warning(
                self.file,
                "events",
                "no events",
                "the event recording",
                "Methods that use events will refuse this capture.",
            )
            return None
        keys = ("file", "width", "height", "contrast_threshold", "simulated", "clock_offset_us")
        entry = self.fields("events", value, keys)
        file = entry.path("file", self.path)
        width, height = entry.integer("width", minimum=1), entry.integer("height", minimum=1)
        thresholds = entry.numbers("contrast_threshold", (2,), None)
        low, high = _THRESHOLDS
        if thresholds is not None and not ((thresholds >= low) & (thresholds <= high)).all():
            entry.fail(
                "contrast_threshold",
                str(thresholds.tolist()),
                f"two positive numbers [C+, C-], {low:g} to {high:g}, or null",
                "Give magnitudes of a change of the natural logarithm, or null where unknown.",
            )
        simulated = entry.get("simulated", False)
        if not isinstance(simulated, bool):
            entry.fail("simulated", brief(simulated), "true or false", "Correct it.")
        offset = entry.integer("clock_offset_us", 0)
        if not entry.valid or file is None:
            return None
        pair = None if thresholds is None else (float(thresholds[0]), float(thresholds[1]))
        return EventsEntry(file, width, height, pair, simulated, offset)


def default_split(index: int) -> str:
    """The split where a capture gives none: three frames of ten are test."""
    return "test" if index % 10 in (7, 8, 9) else "train"
