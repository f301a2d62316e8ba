"""Events that a simulated sensor would send, had it seen the film."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from evsplat.events import (
    EventStore,
    EventStream,
    SensorSettings,
    count_map,
    simulate_events,
    write_events,
)
from evsplat.film.kept import KeptPictures, Shot
from evsplat.film.looks import linear_luma
from evsplat.pictures import signed_map

_FULL_SCALE = 3.0
"""Events of a pixel in one picture that get the strongest colour."""
_PIECE_US = 100_000


def simulate_film(
    kept: KeptPictures, shots: Sequence[Shot], settings: SensorSettings, seed: int = 0
) -> EventStore:
    """Show the kept light to a sensor and put its events into a store beside it."""
    camera = shots[0].camera
    path = kept.path / "events.h5"
    light = ((shot.clock_us, linear_luma(kept.read(shot))) for shot in shots)
    write_events(
        path, simulate_events(light, settings, seed), width=camera.width, height=camera.height
    )
    return EventStore(path, camera.width, camera.height)


def copy_events(
    store: EventStore, out: Path | str, shots: Sequence[Shot], settings: SensorSettings
) -> int:
    """Write the events to a file of any format that `write_events` knows; gives their count."""
    start, end = shots[0].clock_us, shots[-1].clock_us + 1
    pieces = (store.between(at, min(at + _PIECE_US, end)) for at in range(start, end, _PIECE_US))
    told = {f"sensor_{name}": value for name, value in settings.to_dict().items()}
    return write_events(
        out,
        pieces,
        width=store.width,
        height=store.height,
        attributes={"simulated": True, "source": "evsplat render", **told},
    )


def event_pictures(
    store: EventStore, edges_us: Sequence[int]
) -> Iterator[UInt8[np.ndarray, "H W 3"]]:
    """One picture per window between successive edges: red brighter, blue darker, white neither."""
    for start, end in zip(edges_us[:-1], edges_us[1:], strict=True):
        yield event_picture(store.between(start, end), store.height, store.width)


def event_picture(events: EventStream, height: int, width: int) -> UInt8[np.ndarray, "H W 3"]:
    """The signed count of events per pixel in colours."""
    return signed_map(count_map(events, height, width), _FULL_SCALE)
