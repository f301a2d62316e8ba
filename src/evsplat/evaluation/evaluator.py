"""One evaluator for all methods: figures and pictures of a reconstruction's test frames."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from tqdm import tqdm

from evsplat.capture import Capture, Frame, Policy, TrainingCapture
from evsplat.errors import DataError
from evsplat.evaluation.chroma import chroma_psnr
from evsplat.evaluation.drawn import DrawnFrames, KeepPicture, drawn_frame
from evsplat.evaluation.event_maps import evaluate_event_maps
from evsplat.evaluation.novel_views import evaluate_novel_views
from evsplat.evaluation.protocols import (
    METRICS,
    PROTOCOLS,
    STANDARD,
    Measured,
    MetricMeans,
    Networks,
    Protocol,
    Truth,
    all_absent,
    without_reasons,
)
from evsplat.evaluation.regions import Absent, HumanRegions
from evsplat.evaluation.splits import check_split
from evsplat.evaluation.tables import missing_networks
from evsplat.meanwhile import meanwhile
from evsplat.methods.reconstruction import Reconstruction
from evsplat.methods.trivial import TRIVIAL, OnMedianBackground
from evsplat.names import file_stem
from evsplat.options.runs import Split
from evsplat.pictures import error_map, to_bytes
from evsplat.pictures.files import save_png
from evsplat.similarity.lpips import load_lpips
from evsplat.similarity.perceptual import PerceptualMetric
from evsplat.similarity.st_lpips import load_st_lpips
from evsplat.weights import MissingWeights

logger = logging.getLogger(__name__)

BLURRY_INPUT = "blurry_input"
"""The picture that the camera took at the test time: no method, for no method sees it."""
COMPOSITED = "on_median_background"
"""The person of a method without scene, before the median of the training frames."""

_KEPT_BYTES = 128 << 20
"""Of each network's features: rows share pictures, and a picture is compared more than once."""

Picture = Callable[[Frame], Float[Tensor, "H W 3"]]

_TRIVIAL_SEES = Policy()
"""Rows without a method see training frames alone, as the methods do."""


def evaluate(
    capture: Capture,
    reconstruction: Reconstruction,
    *,
    out_dir: Path | str,
    protocols: Sequence[Protocol] = PROTOCOLS,
    lpips_weights: Path | str | None = None,
    device: torch.device | str = "cpu",
    test_frames_only: bool = False,
    human_only: bool = False,
    split: Split = "test",
    beside: Reconstruction | None = None,
) -> dict[str, Any]:
    """Measure ``reconstruction`` on the test frames and novel views of ``capture``.

    Returns what metrics.json holds, less the facts of a run; pictures go to ``out_dir/pictures``.
    ``test_frames_only`` leaves out trivial rows, blurry truth, novel views and event maps, and
    their keys. ``human_only`` says that the reconstruction draws a person on black: it is measured
    once more before the median background ("composited", by protocol), since against a full frame
    the black alone decides.
    ``split="train"`` measures the training frames instead, which needs their sharp truth, and no
    events; the nearest training frame is then the frame itself and has no row. ``beside`` is drawn
    in novel views where it is another.
    Every figure is a mean over frames of per-frame values. What cannot be measured is None,
    with the reason under "reasons" (a path of keys). Pictures are handled one by one, so that
    memory does not grow with the length of the recording.

    Raises:
        ConfigError: ``split`` is another word.
        DataError: no training frame has a sharp truth and ``split`` is "train".
    """
    check_split(split)
    frames = _frames_of(capture, split)
    out_dir = Path(out_dir)
    networks, weights = _load_networks(lpips_weights, device)
    protocols = (STANDARD, *(protocol for protocol in protocols if protocol is not STANDARD))
    human_regions = HumanRegions(capture)
    drawn_frames = DrawnFrames(capture, reconstruction)
    with meanwhile() as do:

        def keep(path: str, picture: np.ndarray) -> None:
            do(save_png, out_dir / path, picture)

        measured = _MeasuredFrames(
            capture,
            reconstruction,
            drawn_frames,
            protocols,
            networks,
            human_regions,
            keep,
            split=split,
            only=test_frames_only,
            human_only=human_only,
        )
        for frame in tqdm(frames, desc=f"{split} frames", unit="frame", leave=False, disable=None):
            measured.measure(frame)
        result = {
            "capture": capture.name,
            "method": reconstruction.name,
            "split": split,
            "frames": {"train": len(capture.train_frames), "test": len(capture.test_frames)},
            **measured.results(),
        }
        reasons: dict[str, str] = result["reasons"]
        if not test_frames_only:
            result["novel_views"] = evaluate_novel_views(
                capture, beside or reconstruction, networks, human_regions, keep, reasons, split
            )
            result["events"] = _event_maps(capture, drawn_frames, keep, reasons, split)
    remark = measured.human_remark()
    result["remarks"] = [remark] if remark else []
    result["weights"] = weights
    result["protocol_notes"] = {protocol.name: protocol.summary for protocol in protocols}
    _tell(result)
    return result


def _tell(result: dict[str, Any]) -> None:
    """Log how the figures may mislead, and which distances are left out for want of weights."""
    for sentence in result["remarks"]:
        logger.warning("%s", sentence)
    for sentence in missing_networks(result):
        logger.info("%s", sentence)


def _frames_of(capture: Capture, split: Split) -> tuple[Frame, ...]:
    """The frames of a split; a `DataError` where no training frame has a truth.

    Held-out frames without truth have at least pictures to look at.
    """
    if split == "test":
        return capture.test_frames
    frames = capture.train_frames
    if all(frame.sharp is None for frame in frames):
        raise DataError(
            f"{capture.path / 'capture.json'}: none of the {len(frames)} training "
            "frames names a sharp picture, expected the truth to measure them against; captures of "
            "'evsplat stage' and 'evsplat synthesize' have it. Measure the test frames instead."
        )
    return frames


@dataclass(eq=False)
class _MeasuredFrames:
    """All rows and protocols over the frames of a split."""

    capture: Capture
    reconstruction: Reconstruction
    drawn: DrawnFrames
    """Those of the reconstruction."""
    protocols: Sequence[Protocol]
    """`STANDARD` comes first; the report shows its figures of every frame and row."""
    networks: Networks
    human_regions: HumanRegions
    keep: KeepPicture
    split: Split
    only: bool
    """Measure the reconstruction alone, and no other rows."""
    human_only: bool

    def __post_init__(self) -> None:
        self._others: dict[str, Picture | Absent] = {}
        if self.human_only:
            composited = partial(OnMedianBackground, self.reconstruction)
            self._others[COMPOSITED] = _picture_of(composited, self.capture)
        if not self.only:
            self._others |= {
                **{name: _picture_of(kind, self.capture) for name, kind in TRIVIAL.items()},
                BLURRY_INPUT: self.capture.image,
            }
            if self.split == "train":
                del self._others["nearest_frame"]
        rows = ("method", *self._others)
        self._means = {(row, p.name): MetricMeans() for row in rows for p in self.protocols}
        self._against_blurry = MetricMeans()
        self._chroma: list[dict[str, float]] = []
        self._per_frame: list[dict[str, Any]] = []
        self._showing = 0
        """Frames that show the person."""

    def measure(self, frame: Frame) -> None:
        """Measure one frame and write its pictures."""
        ours = self.drawn(frame)
        mask, human = self.human_regions.in_frame(frame)
        self._showing += not isinstance(human, Absent)
        truth = None if frame.sharp is None else self.capture.sharp(frame)
        pictures = {"method": ours, **self._other_pictures(frame)}
        measured: dict[str, dict[str, Measured]] = {row: {} for row in pictures}
        for protocol in self.protocols:
            reference = (
                None if truth is None else Truth(protocol, truth, mask, human, self.networks)
            )
            for row, picture in pictures.items():
                measured[row][protocol.name] = _compare(reference, picture)
                self._means[row, protocol.name].add(measured[row][protocol.name])
        if truth is not None and mask is not None and bool(mask.any()):
            self._chroma.append(chroma_psnr(ours, truth, mask))
        entry = {
            "frame": frame.name,
            "time_us": frame.mid_us,
            "protocols": {
                name: without_reasons(values) for name, values in measured["method"].items()
            },
        }
        if not self.only:
            blurry = Truth(STANDARD, self.capture.image(frame), mask, human, self.networks)
            against_blurry = blurry.measure(ours)
            self._against_blurry.add(against_blurry)
            entry["others"] = {
                row: without_reasons(measured[row][STANDARD.name]) for row in self._others
            }
            entry["blurry_ground_truth"] = without_reasons(against_blurry)
        self._per_frame.append(entry | {"pictures": self._save(frame, ours, truth)})

    def human_remark(self) -> str:
        """A sentence where some measured frame does not show the person: there the scene counts."""
        measured = len(self._per_frame)
        if self._showing == measured:
            return ""
        if self._showing:
            return (
                f"{self.capture.path}: the person is in {self._showing} of {measured} {self.split} "
                "frames: crop and mask are figures of these, the full frame of all, where rows "
                "without a method may be perfect."
            )
        return (
            f"{self.capture.path}: the person is in no {self.split} frame, so the figures are of "
            "the scene alone and rows without a method may be perfect; check camera and poses."
        )

    def results(self) -> dict[str, Any]:
        """Means of everything; "trivial" and "blurry_input" are of the protocol standard."""
        reasons: dict[str, str] = {}

        def means(frames: MetricMeans, path: str) -> dict[str, Any]:
            values, why = frames.means()
            reasons.update({f"{path}.{key}": reason for key, reason in why.items()})
            return values

        def row(name: str, protocol: Protocol, path: str) -> dict[str, Any]:
            return means(self._means[name, protocol.name], path)

        compat = [protocol for protocol in self.protocols if protocol is not STANDARD]
        rows = {"protocols": "method"}
        if self.human_only:
            rows["composited"] = COMPOSITED
        method = {
            key: {p.name: row(name, p, f"{key}.{p.name}") for p in self.protocols}
            for key, name in rows.items()
        }
        chroma = None
        if self._chroma:
            count = len(self._chroma)
            chroma = {key: sum(f[key] for f in self._chroma) / count for key in self._chroma[0]}
        else:
            reasons["chroma"] = "no frame has both a sharp ground truth and a person mask"
        frames = {"chroma": chroma, "per_frame": self._per_frame, "reasons": reasons}
        if self.only:
            return {**method, **frames}
        return {
            **method,
            "trivial": {
                name: row(name, STANDARD, f"trivial.{name}")
                for name in TRIVIAL
                if name in self._others
            },
            BLURRY_INPUT: row(BLURRY_INPUT, STANDARD, BLURRY_INPUT),
            "compat_rows": {
                p.name: {
                    name: row(name, p, f"compat_rows.{p.name}.{name}") for name in self._others
                }
                for p in compat
            },
            "blurry_ground_truth": means(self._against_blurry, "blurry_ground_truth"),
            **frames,
        }

    def _other_pictures(self, frame: Frame) -> dict[str, Tensor | Absent]:
        pictures = {
            row: picture if isinstance(picture, Absent) else picture(frame)
            for row, picture in self._others.items()
        }
        if BLURRY_INPUT in pictures and self.capture.is_own_truth(frame):
            pictures[BLURRY_INPUT] = Absent("the camera's own picture is taken as the sharp truth")
        return pictures

    def _save(self, frame: Frame, ours: Tensor, truth: Tensor | None) -> dict[str, str]:
        stem = file_stem(self.split, frame.name)
        shown = self.capture.shown(ours)
        pictures = {"render": to_bytes(shown)}
        if truth is not None:
            pictures["error"] = error_map(shown, self.capture.shown(truth))
        paths = {kind: f"pictures/{stem}_{kind}.png" for kind in pictures}
        for kind, picture in pictures.items():
            self.keep(paths[kind], picture)
        return paths


def _compare(reference: Truth | None, picture: Tensor | Absent) -> Measured:
    if reference is None:
        return all_absent("the frame has no sharp ground truth")
    return all_absent(picture.reason) if isinstance(picture, Absent) else reference.measure(picture)


def _event_maps(
    capture: Capture,
    drawn_frames: DrawnFrames,
    keep: KeepPicture,
    reasons: dict[str, str],
    split: Split,
) -> dict[str, Any] | None:
    """Event maps between frames; None where there are none, with the reason in ``reasons``."""
    events: dict[str, Any] | Absent = Absent("they are measured with the test frames")
    if split == "test":
        events = evaluate_event_maps(capture, drawn_frames, keep)
    if isinstance(events, Absent):
        reasons["events"] = events.reason
        return None
    return events


def _picture_of(
    kind: Callable[[TrainingCapture], Reconstruction], capture: Capture
) -> Picture | Absent:
    try:
        return partial(drawn_frame, capture, kind(capture.for_training(_TRIVIAL_SEES)))
    except DataError as error:
        return Absent(str(error))


def _load_networks(
    lpips_weights: Path | str | None, device: torch.device | str
) -> tuple[dict[str, PerceptualMetric | Absent], dict[str, dict[str, str | None]]]:
    """The network distances, and of each the SHA-256 of its weights or the reason for none."""
    loaders: dict[str, Callable[[], PerceptualMetric]] = {
        "lpips_alex": lambda: load_lpips("alex", lpips_weights, device=device),
        "lpips_vgg": lambda: load_lpips("vgg", lpips_weights, device=device),
        "st_lpips": lambda: load_st_lpips(device=device),
    }
    assert tuple(loaders) == METRICS[2:]
    networks: dict[str, PerceptualMetric | Absent] = {}
    weights: dict[str, dict[str, str | None]] = {}
    for name, load in loaders.items():
        try:
            network = load()
        except MissingWeights as error:
            networks[name] = Absent(f"no weights: see weights.{name}.reason")
            weights[name] = {"sha256": None, "reason": str(error)}
        else:
            networks[name] = network.keeping(_KEPT_BYTES)
            weights[name] = {"sha256": network.sha256, "reason": None}
    return networks, weights
