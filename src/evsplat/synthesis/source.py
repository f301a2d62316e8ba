"""What sharp pictures bring along into the new capture, whatever they come from."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
from jaxtyping import Int64

from evsplat.capture import BodyFile, CaptureWriter
from evsplat.events import EventStream
from evsplat.footage import Footage


@dataclass(frozen=True, eq=False)
class RecordedEvents:
    """Events that a source has of its own."""

    pieces: Iterator[EventStream]
    contrast_threshold: tuple[float, float] | None
    simulated: bool


class Source(Protocol):
    """Sharp pictures with what belongs to them."""

    footage: Footage
    camera: str
    """Name of the camera that took them."""

    def describe(self) -> dict[str, Any]:
        """What provenance says of the source."""
        ...

    def declare(self, writer: CaptureWriter) -> None:
        """Add the cameras."""
        ...

    def extras(self, index: int) -> dict[str, Any]:
        """Options of `CaptureWriter.add_frame` that go with the source picture of that index."""
        ...

    def split(self, index: int) -> Literal["train", "test"]:
        """The source's own split; `ConfigError` where it has none."""
        ...

    def events(self) -> RecordedEvents:
        """The source's own events; `ConfigError` where it has none."""
        ...

    def complete(self, writer: CaptureWriter, frames: Mapping[str, int]) -> None:
        """Add the body and the rest; ``frames`` are names and mid-exposures of those made."""
        ...


def set_body(
    writer: CaptureWriter,
    body: BodyFile,
    dense: BodyFile | None,
    middles_us: Int64[np.ndarray, "M"],
) -> None:
    """Key poses are those at mid-exposures; all there are, or the denser truth, go beside them."""
    nearest = np.abs(body.times_us[None] - middles_us[:, None]).argmin(axis=1)
    keys = np.unique(nearest)
    truth = dense or body
    writer.set_body(
        body.model,
        body.times_us[keys],
        body.poses[keys],
        body.transl[keys],
        rig=body.rig,
        betas=body.betas,
        gender=body.gender,
        dense=(truth.times_us, truth.poses, truth.transl),
    )
