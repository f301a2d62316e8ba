"""`TrainingCapture`: the part of a recording that a training may see; all else raises."""

import functools
from bisect import bisect_left, bisect_right
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import accumulate, groupby
from pathlib import Path
from typing import Protocol

import numpy as np
from jaxtyping import Float
from torch import Tensor

from evsplat.calibration import FramePair, Lost, SensorEstimate, flicker_period_us
from evsplat.camera import Camera
from evsplat.capture.body_file import BodyFile
from evsplat.capture.metadata import Frame, NovelView
from evsplat.capture.policy import EventUse, Policy, Terms
from evsplat.capture.read import CaptureReader
from evsplat.errors import DataError, HeldOutError
from evsplat.events import ALWAYS, EventStore, Span
from evsplat.pictures.light import Transfer

_KEPT_EVENT_BYTES = 256 << 20
"""Of decoded events: estimates before a training and its steps ask for the same ones."""
_A_MINUTE_US = 60_000_000
"""A pixel that is hot fires a few hundred times in it."""
_KEPT_MASKS = 64
"""Estimated masks kept in memory; the least recently used one goes first."""


class HumanFinder(Protocol):
    """Finder of the person in frames (`evsplat.masks.Masker`)."""

    def masks(
        self, capture: "TrainingCapture", frames: Sequence[Frame]
    ) -> Iterator[tuple[Frame, Float[Tensor, "H W"]]]:
        """Each of ``frames`` with the person's share per pixel, in [0, 1]."""
        ...


class TrainingCapture:
    """The part of a capture that methods, restorers, maskers and calibration see, by a `Policy`.

    Of a held-out frame that is its camera, its time and (by the policy) its key pose. Truth, dense
    poses and novel views are seen of no frame. To ask for anything hidden is a `HeldOutError`;
    nothing is left out silently: whoever reads events chooses windows within `readable_around`.
    """

    def __init__(
        self,
        source: CaptureReader,
        policy: Policy,
        masker: "Callable[[TrainingCapture], HumanFinder] | None" = None,
    ) -> None:
        """See `Capture.for_training`."""
        self._source = source.with_nothing_held_out() if policy.use == "everything" else source
        self._masker = masker
        self._masks: OrderedDict[str, Tensor] = OrderedDict()
        self.policy = policy
        self.shared_pairs: list[FramePair] | None = None
        """Pairs of frames that who asks next may have, empty until somebody does; None: they are
        made anew for everybody. See `evsplat.capture.shared_pairs`."""
        self.lost: Lost | None = None
        """Where events were lost, once `evsplat.capture.lost_events` has looked for it."""
        self.sensor_estimate: tuple[SensorEstimate | None] | None = None
        """What frames tell of the sensor, once `evsplat.capture.estimate_sensor` has tried."""
        self.path: Path = source.path
        self.name: str = source.name
        self.frames: tuple[Frame, ...] = tuple(self._redacted(f) for f in self._source.frames)
        """All frames in order; of those held out only name, camera and times mean anything."""

    def __repr__(self) -> str:
        return f"TrainingCapture({str(self.path)!r}, {self.policy})"

    @functools.cached_property
    def train_frames(self) -> tuple[Frame, ...]:
        """Frames whose pictures are seen."""
        return tuple(frame for frame in self.frames if frame.split == "train")

    @functools.cached_property
    def held_out_frames(self) -> tuple[Frame, ...]:
        """Frames of which camera and time alone are known."""
        return tuple(frame for frame in self.frames if frame.split != "train")

    def terms(self, use: EventUse = "amounts", *, thresholds_found: bool = True) -> Terms:
        """The policy as this recording meets it: what it does not give is estimated, or missing.

        ``use`` is what a method takes of the events; pictures that were restored by thresholds show
        both to a method that asks for neither. ``thresholds_found``: that it found those that are
        not given.
        """
        source = self._source
        restored = source.provenance.get("restored")
        if isinstance(restored, dict) and "contrast_threshold" in restored:
            use = "amounts"
        terms = Terms(
            **vars(self.policy),
            events=source.events is not None,
            event_use=use,
            thresholds_found=thresholds_found,
        )
        if source.contrast_threshold is None:
            terms = replace(terms, thresholds="estimated")
        if terms.masks == "given" and "masks" in source.provenance:
            terms = replace(terms, masks="estimated")
        return terms

    def frame(self, name: str) -> Frame:
        """The frame of that name."""
        return self.frames[self._source.frame(name).index]

    def neighbours(self, frame: Frame) -> tuple[Frame, ...]:
        """The frames in order of time about a training frame, up to the next held-out ones."""
        return self._runs[self._seen(frame, "neighbours")]

    @functools.cached_property
    def _runs(self) -> dict[str, tuple[Frame, ...]]:
        """Frames about each training frame, by its name, up to the next held-out ones."""
        ordered = sorted(self.frames, key=lambda frame: frame.mid_us)
        runs: dict[str, tuple[Frame, ...]] = {}
        for split, group in groupby(ordered, key=lambda frame: frame.split):
            run = tuple(group)
            runs |= {frame.name: run for frame in run if split == "train"}
        return runs

    def camera(self, frame: Frame | str) -> Camera:
        """The pinhole camera of any frame, held out or not (`Capture.camera`)."""
        return self._source.camera(self._name(frame))

    def cameras_at(self, camera: str, times_us: Sequence[int]) -> tuple[Camera, ...]:
        """The camera of that name at each time (`Capture.cameras_at`)."""
        return self._source.cameras_at(camera, times_us)

    def transfer(self, frame: Frame | str) -> Transfer:
        """From the values of a frame's pictures to light (`Capture.transfer`)."""
        return self._source.transfer(self._name(frame))

    def is_distorted(self, camera: str) -> bool:
        """True where the lens of a camera distorts (`Capture.is_distorted`)."""
        return self._source.is_distorted(camera)

    def undistort(
        self, camera: str, pixels: Float[np.ndarray, "*batch 2"]
    ) -> Float[np.ndarray, "*batch 2"]:
        """Where pixels of a recorded picture are in the one that is read (`Capture.undistort`)."""
        return self._source.undistort(camera, pixels)

    @property
    def is_static_camera(self) -> bool:
        """True where all frames come from one camera that stands still."""
        return self._source.is_static_camera

    def recorders(self) -> list[Camera]:
        """Cameras of the training frames, of a camera that stands still the one."""
        frames = self.train_frames
        return [self.camera(frame) for frame in (frames[:1] if self.is_static_camera else frames)]

    def image(self, frame: Frame | str) -> Float[Tensor, "H W 3"]:
        """The blurry picture of a training frame."""
        return self._source.image(self._seen(frame, "picture"))

    def has_mask(self, frame: Frame | str) -> bool:
        """True where `mask` gives one; False where the policy shows none."""
        own = self.frame(self._name(frame))
        if self.policy.masks == "estimated":
            return own.split == "train"
        return own.mask is not None  # redacted where it is not seen

    @property
    def takes_masks(self) -> bool:
        """Whether masks can be added to the capture itself (`Capture.takes_masks`)."""
        return self._source.takes_masks

    def mask(self, frame: Frame | str) -> Float[Tensor, "H W"] | None:
        """Share of the person per pixel in a training frame, in [0, 1]; None where it has none."""
        name = self._seen(frame, "mask")
        if self.policy.masks == "none":
            raise HeldOutError(
                f"{self.path}: the mask of frame {name!r} was asked for, and this training sees "
                "none; pass --set policy.masks=given, or estimated."
            )
        return self._source.mask(name) if self.policy.masks == "given" else self._estimated(name)

    def median_background(self) -> Float[Tensor, "H W 3"]:
        """Per-pixel temporal median of the training frames (`Capture.median_background`)."""
        return self._source.median_background()

    @functools.cached_property
    def events(self) -> EventStore | None:
        """The events that are seen, on the camera's clock; None where the capture has none.

        Whoever asks again for what was read gets it decoded, as far as memory for that goes.
        """
        events = self._source.events
        if events is None:
            return None
        return events.restricted_to(self._readable_us).keeping(_KEPT_EVENT_BYTES)

    @property
    def minute_around_us(self) -> Span:
        """From the first training exposure to the last, or at least a minute about their middle."""
        spans = [frame.exposure_us for frame in self.train_frames]
        start, end = min(span[0] for span in spans), max(span[1] for span in spans)
        missing = max(0, _A_MINUTE_US - (end - start))
        return start - missing // 2, end + missing // 2

    @functools.cached_property
    def flicker_us(self) -> int:
        """Period of lamps that flicker, microseconds, as events about the training frames tell it.

        0 where they do not. It is looked for once: up to 20 million events are read for it.
        """
        if self.events is None:
            return 0
        return flicker_period_us(self.events, self.minute_around_us) or 0

    @property
    def contrast_threshold(self) -> tuple[float, float] | None:
        """C+ and C-; None where the capture or the policy does not give them."""
        return self._source.contrast_threshold if self.policy.thresholds == "given" else None

    @property
    def up(self) -> tuple[float, float, float] | None:
        """Upwards in the world, of any length; None where nobody says."""
        return self._source.up

    @property
    def has_body(self) -> bool:
        """True where body and poses are given."""
        return self._source.has_body

    @property
    def poses_refined(self) -> bool:
        """Whether `evsplat poses` tried to correct what it had found by drawing the person."""
        return self._source.poses_refined

    @property
    def body_file(self) -> BodyFile:
        """The body with the key poses that are seen.

        Inside a held-out interval that is a frame's own key pose, or the two on either side of its
        mid-exposure; with ``held_out_poses=interpolated`` none.
        """
        file = self._source.body_file
        kept = self._kept_keys(file.times_us)
        if kept.all():
            return file
        if not kept.any():
            raise DataError(
                f"{file.path}: every key pose lies in a held-out interval, so that training sees "
                "none; give poses of the training frames."
            )
        return file.at_keys(kept)

    @property
    def dense_body_file(self) -> BodyFile | None:
        """Raises: true poses between the keys are for evaluation."""
        raise HeldOutError(f"{self.path}: body_dense.npz is for evaluation only.")

    def sharp(self, frame: Frame | str) -> Float[Tensor, "H W 3"]:
        """Raises: the truth is for evaluation."""
        raise HeldOutError(
            f"{self.path}: the sharp picture of frame {self._name(frame)!r} is for evaluation only."
        )

    @property
    def novel_views(self) -> tuple[NovelView, ...]:
        """Raises: pictures of other cameras are for evaluation."""
        raise HeldOutError(f"{self.path}: novel views are for evaluation only.")

    def _redacted(self, frame: Frame) -> Frame:
        given = frame.split == "train" and self.policy.masks == "given"
        mask = frame.mask if given else None
        if frame.sharp is None and frame.mask is mask:
            return frame
        return replace(frame, sharp=None, mask=mask)

    def _name(self, frame: Frame | str) -> str:
        return frame if isinstance(frame, str) else frame.name

    def _seen(self, frame: Frame | str, what: str) -> str:
        """The name of a frame that trains; else a `HeldOutError`."""
        name = self._name(frame)
        if self.frame(name).split != "train":
            raise HeldOutError(
                f"{self.path}: the {what} of frame {name!r} was asked for, which is held out from "
                "training; evaluation alone sees it."
            )
        return name

    def _estimated(self, name: str) -> Tensor:
        if self._masker is None:
            raise HeldOutError(f"{self.path}: nothing was given that estimates masks.")
        if name not in self._masks:
            capture, finder = self._finder
            ((_, mask),) = finder.masks(capture, [capture.frame(name)])
            self._masks[name] = mask
            if len(self._masks) > _KEPT_MASKS:
                self._masks.popitem(last=False)
        self._masks.move_to_end(name)
        return self._masks[name]

    @functools.cached_property
    def _finder(self) -> "tuple[TrainingCapture, HumanFinder]":
        """The finder of people and its capture, whose pictures no mask has changed."""
        assert self._masker is not None
        capture = TrainingCapture(self._source, replace(self.policy, masks="none"))
        return capture, self._masker(capture)

    @property
    def _readable_us(self) -> tuple[tuple[int, int], ...]:
        return (ALWAYS,) if self.policy.held_out_events else readable_spans(self.frames)

    def _kept_keys(self, times_us: np.ndarray) -> np.ndarray:
        edges = np.array(held_out_spans(self.frames), dtype=np.int64).reshape(-1)
        kept: np.ndarray = np.searchsorted(edges, times_us, side="right") % 2 == 0
        if self.policy.held_out_poses == "given":
            mids = np.array([frame.mid_us for frame in self.held_out_frames], dtype=np.int64)
            # the key at mid-exposure, or the nearest one before and the nearest one after
            near = np.concatenate(
                [np.searchsorted(times_us, mids, "right") - 1, np.searchsorted(times_us, mids)]
            )
            kept[near[(near >= 0) & (near < len(times_us))]] = True
        return kept


def held_out_spans(frames: Sequence[Frame]) -> tuple[Span, ...]:
    """Held-out intervals, merged and in order of time, microseconds, ends exclusive.

    Each runs from the end of the last training exposure before a held-out frame to the start of the
    next training exposure after it; mid-exposures decide on before and after, since exposures may
    overlap. Without a training frame on a side it has no end there. No training exposure reaches
    into one, so that of overlapping exposures the training one is seen whole.
    """
    train = sorted((f for f in frames if f.split == "train"), key=lambda frame: frame.mid_us)
    mids = [frame.mid_us for frame in train]
    # Latest end of the first i training exposures, and earliest start of the others.
    ends = list(accumulate((f.exposure_us[1] for f in train), max, initial=ALWAYS[0]))
    starts = list(accumulate((f.exposure_us[0] for f in reversed(train)), min, initial=ALWAYS[1]))
    starts.reverse()
    spans = []
    for frame in frames:
        if frame.split == "train":
            continue
        start = ends[bisect_right(mids, frame.mid_us)]
        end = starts[bisect_left(mids, frame.mid_us)]
        if start < end:
            spans.append((start, end))
    merged: list[Span] = []
    for start, end in sorted(spans):
        if merged and start <= merged[-1][1]:
            merged[-1] = merged[-1][0], max(end, merged[-1][1])
        else:
            merged.append((start, end))
    return tuple(merged)


def readable_spans(frames: Sequence[Frame]) -> tuple[Span, ...]:
    """Stretches between `held_out_spans`, in order of time; all of time where none is held out."""
    edges = [ALWAYS[0]]
    for start, end in held_out_spans(frames):
        edges += [start, end]
    edges.append(ALWAYS[1])
    pairs = zip(edges[::2], edges[1::2], strict=True)
    return tuple((start, end) for start, end in pairs if start < end)
