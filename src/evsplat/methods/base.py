"""Contract of a method: a configuration, and what it is put together to for one capture."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Literal, Protocol

import torch
from torch import Tensor, nn

from evsplat.body import BodyTrack, track_silhouette
from evsplat.camera import Camera
from evsplat.capture import Frame, Policy, TrainingCapture
from evsplat.capture.policy import EventUse
from evsplat.errors import ConfigError, DataError
from evsplat.gaussians import BodyFrames, DensifyLimits, Part
from evsplat.methods.learning import Learning
from evsplat.methods.settings import Weight
from evsplat.models.at_rest import Skinned
from evsplat.models.seen import Seen
from evsplat.models.solid_scene import SolidScene
from evsplat.objectives import Objective, PackedBounds

_MOST_BODY_FRAMES = 512
"""Frames that tell where a Gaussian dwells which changes its class."""
_KEPT_BOUNDS_BYTES = 32 << 20
"""Of the person's places in frames, which are found again when their frame comes again."""

Purpose = Literal["train", "resume", "draw"]
"""``train``: from the start, with the cheap fits before it. ``resume``: a checkpoint brings all
that was learned. ``draw``: likewise, and no objective is asked."""


class MethodConfig(Protocol):
    """Settings that every method has; a frozen dataclass."""

    @property
    def policy(self) -> Policy:
        """Held-out data that training may see."""

    @property
    def iterations(self) -> int:
        """Training steps; all schedules stretch with it."""


def event_use(config: MethodConfig) -> EventUse:
    """What a method with these settings takes of the events."""
    if getattr(config, "event_weight", 0.0) == 0.0:
        return "nothing"
    return "amounts" if getattr(config, "event_term", "paper") == "windows" else "direction"


@dataclass(frozen=True)
class HeldOut:
    """Learning between training steps from frames whose pictures stay unseen."""

    frames: list[Frame]
    objective: Objective
    parameters: list[nn.Parameter]
    """Parameters that these frames alone teach; of the groups in `Learning.networks`."""
    start: float
    """First nominal iteration."""
    every: int
    """Training steps between two of these."""


@dataclass(frozen=True)
class Composition:
    """A method put together for one capture; the loop knows nothing else of it."""

    model: Skinned
    objectives: list[Objective]
    weights: dict[str, Weight]
    """Weight per named term; a term without one is an error of the method."""
    learning: Learning
    densify: dict[Part, DensifyLimits]
    """Limits for ``human`` and ``scene``; classes in one set are edited at the same steps."""
    body_frames: BodyFrames | None
    """The body at the training frames, for Gaussians that change class; None where none does."""
    generator: torch.Generator
    """All randomness of the training; part of the checkpoint."""
    capture: TrainingCapture | None = None
    """The recording as the method sees it, where that is not all of it (masked pictures)."""
    held_out: HeldOut | None = None
    watched: tuple[str, ...] = ()
    """Terms that compare pictures: how their weighted sum falls tells when little more is to come,
    and a new run that was given no number of steps ends earlier then. Without any it never does."""
    recording: Camera | None = None
    """The camera at rest, which sees no depth: the scene stays as far away from it as it starts,
    and goes on beside the recorded picture. None: it moves anywhere, and black is beside it."""
    fill: Callable[[Seen], tuple[dict[str, Tensor], SolidScene | None]] | None = None
    """Parameters by their names in the model's state, as a prior decides them at the end where
    little was seen, and the scene as it is seen from elsewhere; None: as they were learned."""
    thresholds_found: bool = True
    """False: the method takes events by their contrast thresholds, and neither the capture nor its
    training frames told them where training began."""


def start_of_randomness(seed: int) -> torch.Generator:
    """Generator of all randomness of a run; networks start from torch's own, seeded alike."""
    torch.manual_seed(seed)
    return torch.Generator().manual_seed(seed)


def require_training_frames(capture: TrainingCapture) -> None:
    """A `DataError` where no frame trains."""
    if not capture.train_frames:
        raise DataError(f"{capture.path}: no frame has split 'train'; nothing to learn from.")


def refuse_masks(policy: Policy, method: str) -> None:
    """A `ConfigError` where masks are shown to a method that reads none."""
    if policy.masks != "none":
        raise ConfigError(
            f"policy.masks is {policy.masks}, and method {method} reads no masks; leave it out."
        )


def body_frames(track: BodyTrack, times_us: Sequence[int]) -> BodyFrames:
    """The body as given at the training frames; of many, at some that are evenly spread."""
    times = list(times_us)[:: max(1, -(-len(times_us) // _MOST_BODY_FRAMES))]
    return BodyFrames(track.body, track.bones(times))


def semantic_bounds(
    capture: TrainingCapture, track: BodyTrack, band_px_at_256: float
) -> Mapping[tuple[str, int], Callable[[], PackedBounds]]:
    """Places of the person by the posed body, for each training frame's camera and mid-exposure.

    ``band_px_at_256``: width of the undecided band around it, for a picture 256 pixels high. They
    are found when they are asked for, and those of the frames asked for last are kept.
    """
    frames = capture.train_frames
    sizes = {capture.camera(frame).height * capture.camera(frame).width for frame in frames}
    each = max(sizes, default=1) // 4

    @lru_cache(max(1, _KEPT_BOUNDS_BYTES // max(each, 1)))
    def found(frame: Frame) -> PackedBounds:
        camera = capture.camera(frame)
        mask = track_silhouette(track, frame.mid_us, camera)
        band = max(1, round(band_px_at_256 * camera.height / 256))
        return PackedBounds.of(mask.numpy(), band)

    return _Found({(frame.camera, frame.mid_us): frame for frame in frames}, found)


@dataclass(frozen=True)
class _Found(Mapping[tuple[str, int], Callable[[], PackedBounds]]):
    """What finds a frame's bounds, by camera and time; made when asked for, an hour having many."""

    frames: dict[tuple[str, int], Frame]
    found: Callable[[Frame], PackedBounds]

    def __getitem__(self, place: tuple[str, int]) -> Callable[[], PackedBounds]:
        return partial(self.found, self.frames[place])

    def __contains__(self, place: object) -> bool:
        return place in self.frames

    def __iter__(self) -> Iterator[tuple[str, int]]:
        return iter(self.frames)

    def __len__(self) -> int:
        return len(self.frames)
