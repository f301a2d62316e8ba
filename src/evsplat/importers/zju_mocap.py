"""ZJU-MoCap: the release as it comes, and ARAH's preprocessing of it that 3DGS-Avatar reads."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
from tqdm import tqdm

from evsplat.body.pose_files import read_poses
from evsplat.body.pose_files.fields import numbers
from evsplat.capture.write import CaptureWriter
from evsplat.errors import ConfigError, DataError
from evsplat.importers.base import (
    GUIDE,
    PICTURES,
    Importer,
    SourceCamera,
    add_picture,
    check_positive,
    chosen_frames,
    human_mask,
    need,
    numbered,
    opencv_intrinsics,
    picture,
    rigid,
    table,
    whole_number,
)
from evsplat.importers.option_types import FrameRange, Rate, Shrink
from evsplat.importers.smpl import add_body, chosen_poses, some_of, unposed
from evsplat.options.declare import option
from evsplat.untrusted.arrays import read_npy, read_npz
from evsplat.untrusted.text import read_json

FRAME_RANGES = {"377": (0, 570), "386": (0, 540), "387": (0, 540), "394": (0, 475)}
"""Frames that ARAH and 3DGS-Avatar use; of 392 and 393 they use all."""


@dataclass(frozen=True, kw_only=True)
class ZjuMocap(Importer):
    """ZJU-MoCap, one subject's folder: as released (annots.npy) or preprocessed by ARAH."""

    blur_recipe: ClassVar[str | None] = "zju-mocap-blur"
    brings_masks: ClassVar[bool] = True

    camera: Annotated[str, option("NAME")] = "1"
    """Number of the camera whose pictures become the frames."""
    novel_cameras: Annotated[tuple[str, ...], option("[CAMERA ...]", default="none")] = ()
    """Numbers of other cameras whose pictures are added for evaluation, one per frame each."""
    frames: FrameRange = None
    """First frame and one past the last; by default those of 3DGS-Avatar."""
    shrink: Shrink = 2
    """Pictures are made smaller by this factor (1024 to 512 pixels)."""
    fps: Rate = 50.0
    """Frames per second; the release does not say, and only the ratio to the exposure matters."""

    def write(self, source: Path, writer: CaptureWriter, smpl: Path | None) -> list[str]:
        """Read one subject's folder; see `Importer.write`."""
        check_positive(shrink=self.shrink)
        sequence = _open(source)
        for name in (self.camera, *self.novel_cameras):
            if name not in sequence.cameras:
                raise ConfigError(
                    f"{source}: has no camera {name!r}; there are {', '.join(sequence.cameras)}."
                )
        subject = (re.findall(r"\d{3}", source.resolve().name) or [""])[-1]
        range_ = self.frames or FRAME_RANGES.get(subject)
        kept = chosen_frames(range_, sequence.numbers, source)
        for name in (self.camera, *self.novel_cameras):
            first = need(sequence.image(name, kept[0]), f"a picture of camera {name}")
            sequence.cameras[name].add_to(writer, name, first, self.shrink)
        poses = chosen_poses(read_poses(sequence.poses, body_models=smpl), kept)
        times = [round((number - kept[0]) * 1e6 / self.fps) for number in kept]
        bar = tqdm(kept, desc="pictures", unit="frame", leave=False)
        for number, time_us in zip(bar, times, strict=True):
            self._add_frame(writer, sequence, number, time_us)
        writer.provenance |= {
            "source": "ZJU-MoCap",
            "layout": sequence.layout,
            "sequence": source.resolve().name,
            "camera": self.camera,
            "frames": [kept[0], kept[-1] + 1],
            "shrink": self.shrink,
            "fps_nominal": self.fps,
        }
        return add_body(writer, times, poses, smpl, rest_joints=sequence.rest_joints(kept))

    def _add_frame(
        self, writer: CaptureWriter, sequence: "_Sequence", number: int, time_us: int
    ) -> None:
        name = f"{number:06d}"
        image = need(sequence.image(self.camera, number), f"the picture of frame {number}")
        add_picture(
            writer,
            name,
            image,
            time_us,
            self.shrink,
            camera=self.camera,
            mask=human_mask(sequence.mask(self.camera, number), self.shrink),
        )
        for other in self.novel_cameras:
            view = need(sequence.image(other, number), f"frame {number} of camera {other}")
            writer.add_novel_view(other, name, time_us, picture(view, self.shrink))


@dataclass(frozen=True)
class _Sequence:
    """One subject, whatever the layout."""

    layout: str
    cameras: dict[str, SourceCamera]
    numbers: list[int]
    image: Callable[[str, int], Path]
    mask: Callable[[str, int], Path]
    poses: Path
    rest_joints: Callable[[list[int]], np.ndarray | None]
    """The subject's joints at rest; None where the data has none."""


def _open(source: Path) -> _Sequence:
    need(source, "one subject's folder, such as CoreView_377")
    if (source / "annots.npy").exists():
        return _open_raw(source)
    if (source / "cam_params.json").exists():
        return _open_arah(source)
    raise DataError(
        f"{source}: holds neither annots.npy (ZJU-MoCap as released) nor cam_params.json (ARAH's "
        f"preprocessing), expected the folder of one subject; {GUIDE}."
    )


def _open_raw(source: Path) -> _Sequence:
    file = source / "annots.npy"
    annotations = table(read_npy(file, what="annotation of ZJU-MoCap"), str(file), "'cams', 'ims'")
    try:
        cams, rows = annotations["cams"], [list(map(str, row["ims"])) for row in annotations["ims"]]
    except (KeyError, TypeError, IndexError):
        raise DataError(
            f"{file}: found no 'cams' and 'ims', expected the annotations of ZJU-MoCap."
        ) from None
    if not rows or not rows[0]:
        raise DataError(f"{file}: ims: names no picture, expected one list per frame.")
    names = [_camera_number(Path(path).parent.name) for path in rows[0]]
    cameras = {
        name: _camera(cams, index, f"{file}: cams", millimetres=True)
        for index, name in enumerate(names)
    }
    pictures: dict[tuple[str, int], str] = {}
    for row in rows:
        for name, path in zip(names, row, strict=False):
            pictures[name, _frame_number(path)] = path
    first = sorted(number for name, number in pictures if name == names[0])
    folder = next((f for f in ("new_params", "params") if (source / f).is_dir()), "new_params")
    masks = "mask_cihp" if (source / "mask_cihp").is_dir() else "mask"

    def image(name: str, number: int) -> Path:
        # a camera may have failed at a frame
        return source / pictures.get((name, number), f"camera_{name}_frame_{number}")

    return _Sequence(
        "raw",
        cameras,
        first,
        image,
        lambda name, number: (source / masks / image(name, number).relative_to(source)).with_suffix(
            ".png"
        ),
        need(source / folder, "the folder of SMPL parameters"),
        lambda kept: None,
    )


def _open_arah(source: Path) -> _Sequence:
    file = source / "cam_params.json"
    document = read_json(file)
    names = document.get("all_cam_names") if isinstance(document, dict) else None
    if not isinstance(names, list) or not names:
        raise DataError(f"{file}: all_cam_names: not found, expected the list of cameras.")
    names = [str(name) for name in names]
    cameras = {name: _arah_camera(document, name, str(file)) for name in names}
    models = numbered(source / "models", "ARAH's body parameters", (".npz",))

    def beside(name: str, number: int, suffix: str) -> Path:
        return source / name / f"{models[number].stem}{suffix}"

    def image(name: str, number: int) -> Path:
        paths = [beside(name, number, suffix) for suffix in (".jpg", *PICTURES)]
        found = (path for path in paths if path.exists())
        return next(found, paths[0])

    return _Sequence(
        "ARAH",
        cameras,
        list(models),
        image,
        lambda name, number: beside(name, number, ".png"),
        source / "models",
        lambda kept: _rest_joints([models[number] for number in kept]),
    )


def _arah_camera(document: dict[str, Any], name: str, where: str) -> SourceCamera:
    entry = table(document.get(name), f"{where}: {name}", "K, D, R and T of that camera")
    one = {key: [value] for key, value in entry.items()}
    return _camera(one, 0, f"{where}: {name}", millimetres=False)


def _rest_joints(paths: list[Path]) -> np.ndarray | None:
    """Joints at rest, from the posed joints that ARAH keeps."""
    samples = []
    for path in some_of(paths):
        arrays, where = read_npz(path, what="body parameters"), str(path)
        if "Jtr_posed" not in arrays:
            return None
        parts = (("root_orient", 3), ("pose_body", 63), ("pose_hand", 6))
        turns = [numbers(arrays, key, (size,), where, flat=True) for key, size in parts]
        joints = numbers(arrays, "Jtr_posed", (24, 3), where, flat=True)
        shift = numbers(arrays, "trans", (3,), where, flat=True)
        samples.append((np.concatenate(turns).reshape(24, 3), joints, shift))
    return unposed(samples)


def _camera(cams: Any, index: int, where: str, *, millimetres: bool) -> SourceCamera:
    table(cams, where, "K, D, R and T of the cameras")

    def get(key: str, shape: tuple[int, ...]) -> np.ndarray:
        rows = dict(enumerate(cams.get(key, ())))
        named = {key: rows[index]} if index in rows else {}
        return numbers(named, key, shape, f"{where}: camera {index}", flat=True)

    translation = get("T", (3,)) / (1000 if millimetres else 1)
    pose = rigid(get("R", (3, 3)), translation, f"{where}: R of camera {index}")
    return SourceCamera(opencv_intrinsics(get("K", (3, 3))), pose, tuple(get("D", (5,)).tolist()))


def _camera_number(folder: str) -> str:
    """``Camera_B1`` and ``Camera (1)`` are camera 1."""
    digits = re.findall(r"\d+", folder)
    return digits[-1] if digits else folder


def _frame_number(path: str) -> int:
    """``000012.jpg`` is 12; CoreView_313 and 315 write ``CoreView_313_Camera_(1)_0012_2019-…``."""
    stem = Path(path).stem
    parts = stem.split("_")
    digits = stem if stem.isdecimal() else parts[4] if len(parts) > 4 else ""
    if not digits.isdecimal():
        raise DataError(
            f"annots.npy: {path!r} has no frame number, expected a name like 000012.jpg."
        )
    return whole_number(digits, path)
