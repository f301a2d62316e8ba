"""Pictures of cameras that took no part in the training, compared with what those cameras saw."""

from typing import Any

from torch import Tensor
from tqdm import tqdm

from evsplat.capture import Capture
from evsplat.errors import DataError
from evsplat.evaluation.drawn import KeepPicture, drawn
from evsplat.evaluation.protocols import (
    STANDARD,
    MetricMeans,
    Networks,
    Truth,
    all_absent,
    without_reasons,
)
from evsplat.evaluation.regions import HumanRegions
from evsplat.methods.reconstruction import Reconstruction
from evsplat.names import file_stem
from evsplat.options.runs import Split
from evsplat.pictures import to_bytes


def evaluate_novel_views(
    capture: Capture,
    reconstruction: Reconstruction,
    networks: Networks,
    human_regions: HumanRegions,
    keep: KeepPicture,
    reasons: dict[str, str],
    split: Split,
) -> dict[str, Any]:
    """Standard figures by camera; empty where there are none, with the reason in ``reasons``.

    Beside training frames only views of their times count.
    """
    train = {frame.name for frame in capture.train_frames}
    views = [view for view in capture.novel_views if split == "test" or view.frame in train]
    means_by_camera: dict[str, MetricMeans] = {}
    per_view: dict[str, list[dict[str, Any]]] = {}
    for view in tqdm(views, desc="novel views", unit="picture", leave=False, disable=None):
        camera = capture.cameras[view.camera]
        ours: Tensor | None = None
        try:
            ours = drawn(reconstruction, camera, view.time_us)
        except DataError as error:  # trivial methods know the recording camera only
            measured = all_absent(str(error))
        if ours is not None:
            human = human_regions.in_view(camera, view.time_us)
            truth = Truth(STANDARD, capture.novel_image(view), None, human, networks)
            measured = truth.measure(ours)
        means_by_camera.setdefault(view.camera, MetricMeans(("full", "person_crop"))).add(measured)
        entry = {
            "index": view.index,
            "frame": view.frame,
            "time_us": view.time_us,
            "psnr": without_reasons(measured)["full"]["psnr"],
            "psnr_person_crop": without_reasons(measured)["person_crop"]["psnr"],
            "pictures": {},
        }
        if ours is not None:
            path = f"pictures/{file_stem('novel', view.camera, f'{view.index:04d}')}_render.png"
            keep(path, to_bytes(capture.shown(ours)))
            entry["pictures"] = {"render": path}
        per_view.setdefault(view.camera, []).append(entry)
    result = {}
    for name, camera_means in means_by_camera.items():
        means, why = camera_means.means()
        reasons.update({f"novel_views.{name}.{key}": reason for key, reason in why.items()})
        result[name] = {**means, "per_view": per_view[name]}
    if not result:
        reasons["novel_views"] = "the capture has no novel views"
    return result
