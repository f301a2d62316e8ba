"""``--homography auto``: where another sensor's events lie over the pictures, found on import."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from evsplat.calibration.clock import MOST_LAG_US
from evsplat.calibration.offset import BlockChanges
from evsplat.calibration.two_sensors import ChangesSeen, SensorPlace, estimate_place
from evsplat.capture.write import CaptureWriter
from evsplat.commands import command
from evsplat.errors import DataError
from evsplat.events import EventRecording, moved
from evsplat.events.homography import Homography, Mover
from evsplat.footage import TimedPicture
from evsplat.importers.clock_offset import likely_offsets
from evsplat.pictures.files import to_unit_range

FILE = "events_to_pictures.txt"
"""What was found, in the capture's folder."""
_CALIBRATE = (
    "calibrate both cameras by a board that both see and give what cv2.findHomography(in_events, "
    "in_pictures) says as --homography FILE (docs/own-capture.md, two sensors), or film more that "
    "moves in both views"
)


def given_mover(homography: Path | Literal["auto"] | None, size: tuple[int, int]) -> Mover | None:
    """What moves events into pictures of ``size`` by a file; None where there is none."""
    if homography is None or homography == "auto":
        return None
    return Mover.read(Path(homography), size)


def place_finder(
    homography: Path | Literal["auto"] | None,
    spans_us: Sequence[tuple[int, int]],
    camera: dict[str, Any],
) -> "PlaceFinder | None":
    """What finds the homography from pictures with these exposures, where that is asked for."""
    if homography != "auto":
        return None
    return PlaceFinder(ChangesSeen(spans_us, camera.get("transfer", "power")))


class PlaceFinder:
    """Gathers pictures one at a time, and finds by them where events lie."""

    def __init__(self, seen: ChangesSeen) -> None:
        self._seen = seen

    def add(self, picture: TimedPicture, exposure_us: tuple[int, int]) -> None:
        """The next picture, as recorded."""
        self._seen.add(lambda: to_unit_range(picture.pixels), exposure_us)

    def mover(
        self, sensor: EventRecording, clock_offset: int | BlockChanges, writer: CaptureWriter
    ) -> tuple[Mover, list[str]]:
        """What moves the events of a recording into the pictures, and a note of it.

        The homography is written into the capture and its provenance. A clock that is to be found
        is first looked for with both views laid onto each other as large as they are.

        Raises:
            DataError: Where they lie is not certain, or they are of the other polarity.
        """
        path = sensor.path
        place = self._place(sensor, self._offsets(sensor, clock_offset))
        if place is None:
            raise DataError(
                f"{path}: hardly anything changes in the pictures, or has events, where both were "
                f"recorded; {_CALIBRATE}."
            )
        if place.doubt:
            raise DataError(f"{path}: its events {place.doubt}; {_CALIBRATE}.")
        if place.inverted:
            again = command("convert", path, "NEW.h5", "--invert")
            raise DataError(
                f"{path}: its events agree with the changes of the pictures only if they were of "
                f"the other polarity (correlation {place.correlation:.2f}); write them anew by: "
                f"{again}"
            )
        writer.add_homography(FILE, place.homography, self._seen.size, _certainty(place))
        lag = ""
        if isinstance(clock_offset, int) and abs(place.lag_us) > MOST_LAG_US:
            lag = f"; they are about {place.lag_us / 1000:.0f} ms late (--clock-offset-us)"
        note = (
            f"events: found where they lie over the pictures: {place} (correlation "
            f"{place.correlation:.2f}, elsewhere {place.rival:.2f} at most; standard error "
            f"{place.error_px:.1f} px where something moves){lag}; the capture holds it as {FILE}, "
            "which --homography takes"
        )
        return Mover(writer.path / FILE, place.homography, self._seen.size), [note]

    def _offsets(self, sensor: EventRecording, clock_offset: int | BlockChanges) -> list[int]:
        """Where the clock of the events may be, us, the likeliest first."""
        if isinstance(clock_offset, int):
            return [clock_offset]
        size = self._seen.size
        matrix = _as_large(_size(sensor), size)
        return likely_offsets(
            clock_offset, lambda: moved(sensor.chunks(), matrix, *size), sensor.path, size
        )

    def _place(self, sensor: EventRecording, offsets_us: Sequence[int]) -> SensorPlace | None:
        """By the first of the clocks that leaves no doubt; else by that which fits best.

        Of what swings, a clock that is off by half a period says the other polarity.
        """
        best: SensorPlace | None = None
        for offset_us in offsets_us:
            events = self._seen.events(sensor.chunks(), offset_us)
            place = estimate_place(self._seen, events, _size(sensor))
            if place is None:
                continue
            if not place.doubt and not place.inverted:
                return place
            if best is None or _rank(place) > _rank(best):
                best = place
        return best


def _rank(place: SensorPlace) -> tuple[bool, float]:
    return not place.doubt, place.correlation


def _size(sensor: EventRecording) -> tuple[int, int]:
    """Width and height of the sensor, or of what its events reach where nothing says it."""
    if sensor.width is not None and sensor.height is not None:
        return sensor.width, sensor.height
    reach = [(int(one.x.max()), int(one.y.max())) for one in sensor.chunks() if len(one)]
    width, height = np.max(reach, axis=0) + 1 if reach else (1, 1)
    return int(width), int(height)


def _as_large(sensor: tuple[int, int], size: tuple[int, int]) -> Homography:
    """From the middle of a sensor to that of pictures, as if both saw as much."""
    scale = math.sqrt(size[0] * size[1] / (sensor[0] * sensor[1]))
    matrix = np.diag([scale, scale, 1.0])
    matrix[:2, 2] = (np.array(size) - 1 - scale * (np.array(sensor) - 1)) / 2
    return matrix


def _certainty(place: SensorPlace) -> dict[str, Any]:
    return {
        "correlation": round(place.correlation, 3),
        "elsewhere": round(place.rival, 3),
        "error_px": round(place.error_px, 2),
        "sensor": list(place.sensor_px),
    }
