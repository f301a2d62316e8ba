"""NeuMan: a hand-held camera around a moving person, posed by COLMAP."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from evsplat.body.pose_files import PoseSequence
from evsplat.body.pose_files.fields import numbers
from evsplat.body.pose_files.sequence import make_sequence
from evsplat.capture.write import CaptureWriter
from evsplat.errors import DataError
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
)
from evsplat.importers.colmap import read_colmap
from evsplat.importers.option_types import FrameRange, Rate, Shrink
from evsplat.importers.smpl import add_body, chosen_poses
from evsplat.importers.upright import upright
from evsplat.untrusted.arrays import read_npz


@dataclass(frozen=True, kw_only=True)
class Neuman(Importer):
    """NeuMan, one sequence's folder (bike, citron, jogging, lab, parkinglot, seattle)."""

    brings_masks: ClassVar[bool] = True

    frames: FrameRange = None
    """First frame and one past the last; by default all."""
    shrink: Shrink = 1
    """Pictures are made smaller by this factor."""
    fps: Rate = 30.0
    """Frames per second; the data set does not say."""

    def write(self, source: Path, writer: CaptureWriter, smpl: Path | None) -> list[str]:
        """Read one sequence; see `Importer.write`."""
        check_positive(shrink=self.shrink)
        need(source, "one sequence of NeuMan")
        pictures = numbered(need(source / "images", "the pictures"), "pictures", PICTURES)
        scene = read_colmap(source / "sparse")
        if not scene.shared:
            raise DataError(
                f"{source / 'sparse'}: pictures have different intrinsics, expected one camera; "
                "run COLMAP with ImageReader.single_camera."
            )
        order = list(pictures)
        absent = [path.name for path in pictures.values() if path.name not in scene.cameras]
        if absent:
            raise DataError(
                f"{source / 'sparse' / 'images.txt'}: names no picture {absent[0]} ({len(absent)} "
                f"of {len(order)} are missing), expected the pose of every picture."
            )
        views = [scene.cameras[path.name] for path in pictures.values()]
        sequence, scale = _read_poses(source, views, order)
        # COLMAP's world has any axes; films and viewer take one of them for up.
        trunks = Rotation.from_rotvec(sequence.poses[:, 0]).as_matrix()[:, :, 1]
        turn = upright(np.stack([view.world_to_camera for view in views]), trunks.mean(0))
        kept = chosen_frames(self.frames, order, source)
        first = pictures[kept[0]]
        SourceCamera(views[0].K, np.eye(4), views[0].distortion).add_to(
            writer, "main", first, self.shrink
        )
        times = []
        for number in tqdm(kept, desc="pictures", unit="frame", leave=False):
            pose = views[order.index(number)].world_to_camera.copy()
            pose[:3, :3] = pose[:3, :3] @ turn.T
            pose[:3, 3] /= scale
            mask, turned = _mask(source, pictures[number])
            time_us = round(number * 1e6 / self.fps)
            add_picture(
                writer,
                pictures[number].stem,
                pictures[number],
                time_us,
                self.shrink,
                mask=human_mask(mask, self.shrink, person_is=turned),
                world_to_camera=pose,
            )
            times.append(time_us)
        if len(scene.points):
            writer.set_points(scene.points @ turn.T / scale, scene.colours)
        writer.provenance |= {
            "source": "NeuMan",
            "sequence": source.resolve().name,
            "frames": [kept[0], kept[-1] + 1],
            "shrink": self.shrink,
            "fps_nominal": self.fps,
            "colmap_units_per_metre": scale,
            "world_from_colmap": turn.tolist(),
        }
        return add_body(writer, times, chosen_poses(sequence, kept), smpl, turn=turn)


def _read_poses(
    source: Path, views: list[SourceCamera], frames: list[int]
) -> tuple[PoseSequence, float]:
    """Poses in metres, and COLMAP units per metre.

    The file scales the person per frame: ``v = s v_smpl + transl``. A body has one size, so each
    frame's person is moved along the rays of its camera until the size fits; the picture of it
    stays the same.
    """
    path = source / "4d_humans" / "smpl_optimized_aligned_scale.npz"
    if not path.exists():
        raise DataError(
            f"{path}: not found, expected the poses in COLMAP's world (HUGS's release of NeuMan); "
            f"{GUIDE}."
        )
    arrays, where, count = read_npz(path, what="poses of NeuMan"), str(path), len(views)
    orient = numbers(arrays, "global_orient", (None, 1, 3), where, flat=True)
    if len(orient) != count:
        raise DataError(
            f"{path}: holds {len(orient)} poses, expected {count} as there are pictures."
        )
    limbs = numbers(arrays, "body_pose", (count, 23, 3), where, flat=True)
    transl = numbers(arrays, "transl", (count, 3), where, flat=True)
    scales = np.ones(count)
    if "scale" in arrays:
        found = numbers(arrays, "scale", (None,), where, flat=True)
        if len(found) not in (1, count):
            raise DataError(f"{path}: holds {len(found)} scales, expected 1 or {count}.")
        scales = scales * found
    if not (scales > 0).all():
        raise DataError(f"{path}: scale holds values that are not above 0.")
    scale = float(np.median(scales))
    poses = [view.world_to_camera for view in views]
    centres = np.stack([-pose[:3, :3].T @ pose[:3, 3] for pose in poses])
    sequence = make_sequence(
        model="smpl",
        frames=frames,
        poses=np.concatenate([orient, limbs], axis=1),
        transl=(transl - centres) / scales[:, None] + centres / scale,
        betas=numbers(arrays, "betas", (None, 10), where, flat=True),
        source=where,
        world="calibration",
        pose_source="estimated",
    )
    return sequence, scale


def _mask(source: Path, image: Path) -> tuple[Path | None, str]:
    """HUGS's masks, white on the person, or NeuMan's own, which are white elsewhere."""
    good = source / "4d_humans" / "sam_segmentations" / f"{image.stem}.png"
    if good.exists():
        return good, "nonzero"
    own = [source / "segmentations" / f"{name}.png" for name in (image.name, image.stem)]
    return next((path for path in own if path.exists()), None), "zero"
