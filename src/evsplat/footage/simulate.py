"""Footage to an event recording: what an event camera beside the camera would have seen."""

import logging
from collections.abc import Iterable, Iterator
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from evsplat.errors import ConfigError, DataError
from evsplat.events import EventStream, SensorSettings, simulate_events, write_events
from evsplat.footage import Footage, open_footage
from evsplat.pictures import Transfer, decode, luminance
from evsplat.pictures.files import to_unit_range

logger = logging.getLogger(__name__)

# Between pictures that lie farther apart, light rarely changes evenly.
_COARSE_STEP_US = 5_000
# Pieces of a few pictures each would cost more to append than to simulate.
_PIECE_EVENTS = 1 << 18


def simulate(
    source: Path | str,
    out: Path | str,
    *,
    settings: SensorSettings | None = None,
    source_fps: float | None = None,
    transfer: Transfer = "power",
    seed: int = 0,
) -> int:
    """Write the events that a simulated sensor sees in footage, and return how many there are.

    Times count from the first picture, or as the video has them. Memory does not grow with the
    length of the footage. The file appears when it is complete; an interruption leaves nothing.

    Args:
        source: A video file, or a folder of pictures (8 or 16 bit, grey or RGB).
        out: The event file; its suffix chooses the format, as in `evsplat.events.write_events`.
            HDF5 keeps settings and seed as attributes.
        settings: The sensor, such as ``sensor_settings("davis346", shot_hz=5.0)``; by default an
            ideal one with a threshold of 0.2.
        source_fps: Rate at which the pictures were taken; a folder needs it.
        transfer: Between coded values and linear light.
        seed: Of everything random in the sensor; 0 or more.

    Raises:
        DataError: Footage that cannot be read or has a single picture.
        ConfigError: ``source_fps`` is missing or makes no sense, ``seed`` is below 0, or the suffix
            names no format.
    """
    settings = settings or SensorSettings()
    if seed < 0:
        raise ConfigError(f"--seed {seed}: expected an integer, 0 or more.")
    footage = open_footage(source, source_fps, rate_option="--source-fps")
    steps_us = np.diff(footage.times_us)
    if not len(steps_us):
        raise DataError(f"{source}: holds one picture; events need at least two.")
    if np.median(steps_us) > _COARSE_STEP_US:
        logger.warning(
            "%s: pictures lie %.3g ms apart, and light is taken to change evenly between them; "
            "'evsplat synthesize' makes the pictures in between.",
            source,
            np.median(steps_us) / 1000,
        )
    frames = tqdm(
        _luminances(footage, transfer),
        total=len(footage.times_us),
        unit="picture",
        desc="simulate",
        dynamic_ncols=True,
    )
    pieces = _gathered(simulate_events(frames, settings, seed))
    attributes = {
        "simulated": True,
        # HDF5 has UTF-8 alone for texts, names of files any bytes.
        "source": footage.path.name.encode("utf-8", "backslashreplace").decode(),
        "transfer": transfer,
        "seed": seed,
        **{f"sensor_{name}": value for name, value in asdict(settings).items()},
    }
    try:
        return write_events(
            out, pieces, width=footage.width, height=footage.height, attributes=attributes
        )
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"Stopped; {out} was not written.") from None


def _luminances(footage: Footage, transfer: Transfer) -> Iterator[tuple[int, Tensor]]:
    """Time and (H, W) luminance in linear light of each picture."""
    tables: dict[np.dtype, np.ndarray] = {}
    for picture in footage:
        kind = picture.pixels.dtype
        if kind not in tables:
            levels = np.arange(np.iinfo(kind).max + 1, dtype=kind)
            tables[kind] = decode(to_unit_range(levels), transfer).numpy()
        light = torch.from_numpy(tables[kind][picture.pixels])
        yield picture.time_us, light if light.ndim == 2 else luminance(light)


def _gathered(pieces: Iterable[EventStream]) -> Iterator[EventStream]:
    """The same events in pieces that are worth writing."""
    waiting: list[EventStream] = []
    for piece in pieces:
        waiting.append(piece)
        if sum(map(len, waiting)) >= _PIECE_EVENTS:
            yield EventStream.joined(waiting)
            waiting = []
    if waiting:
        yield EventStream.joined(waiting)
