"""An event camera in software: pictures of linear light in, events out (see docs/simulator.md)."""

from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from typing import Annotated, Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from evsplat.compiled import native_for
from evsplat.config import check
from evsplat.errors import ConfigError, DataError
from evsplat.events.stream import EventStream
from evsplat.options.declare import Sensor, given
from evsplat.pictures.light import luminance
from evsplat.ranges import AtLeast, Within

LOWEST_CONTRAST = 0.01
"""Thresholds, drawn ones too, stay at or above this: one 8-bit level near white is 0.009."""
_LONGEST_STEP_US = 2**31


@dataclass(frozen=True)
class SensorSettings:
    """An event sensor; the defaults are an ideal one without noise."""

    contrast_on: Annotated[float, AtLeast(LOWEST_CONTRAST)] = 0.2
    """Change of log-intensity (natural logarithm) that makes an ON event: C+ of the paper."""
    contrast_off: Annotated[float, AtLeast(LOWEST_CONTRAST)] = 0.2
    """The same for OFF events, positive: C- of the paper."""
    contrast_mismatch: Annotated[float, Within(0, 1)] = 0.0
    """Standard deviation between pixels of both thresholds, as a share of the threshold."""
    response: Literal["log", "lin-log"] = "log"
    """``log``: ln(Y + log_eps); ``lin-log``: v2e's, ln(255 Y) above 255 Y = 20, straight below."""
    log_eps: Annotated[float, AtLeast(1e-6)] = 1e-3
    """Added to linear light in [0, 1] before the logarithm; only read by ``log``."""
    cutoff_hz: Annotated[float, AtLeast(0)] = 0.0
    """Bandwidth of a pixel in full light; it falls with the light, to 7 % in the dark. 0: none."""
    leak_hz: Annotated[float, AtLeast(0)] = 0.0
    """ON events per pixel and second without any change of light."""
    leak_spread: Annotated[float, AtLeast(0)] = 0.0
    """Standard deviation between pixels of log10 of the leak rate, in decades."""
    shot_hz: Annotated[float, AtLeast(0)] = 0.0
    """Noise events (ON and OFF together) per pixel and second in the dark; a quarter of it in
    full light."""
    refractory_us: Annotated[float, AtLeast(0)] = 0.0
    """After an event a pixel sends none for so long; what would have come is lost."""
    hot_pixel_fraction: Annotated[float, Within(0, 1)] = 0.0
    """Share of pixels that send events, ON and OFF alike, all the time."""
    hot_pixel_hz: Annotated[float, AtLeast(0)] = 0.0
    """Events per second of each hot pixel."""

    def __post_init__(self) -> None:
        check(self, "sensor")

    def to_dict(self) -> dict[str, Any]:
        """As JSON holds it."""
        return asdict(self)


PRESETS: dict[Sensor, SensorSettings] = {
    "clean": SensorSettings(),
    "davis346": SensorSettings(
        contrast_on=0.36,
        contrast_off=0.40,
        contrast_mismatch=0.08,
        cutoff_hz=300.0,
        leak_hz=0.2,
        leak_spread=0.1,
        shot_hz=1.0,
        refractory_us=970.0,
    ),
    "dvxplorer": SensorSettings(
        contrast_mismatch=0.15,
        cutoff_hz=300.0,
        leak_hz=0.01,
        leak_spread=0.1,
        shot_hz=0.03,
        refractory_us=200.0,
        hot_pixel_fraction=1e-3,
        hot_pixel_hz=110.0,
    ),
    "evk4": SensorSettings(
        contrast_on=0.22,
        contrast_off=0.22,
        contrast_mismatch=0.14,
        cutoff_hz=1_600.0,
        shot_hz=0.002,
        refractory_us=150.0,
        hot_pixel_fraction=3e-6,
        hot_pixel_hz=25.0,
    ),
}
"""Sensors by name; docs/simulator.md gives the source of each number."""


def sensor_settings(preset: Sensor = "clean", **changes: Any) -> SensorSettings:
    """A preset with some fields changed; those given as None stay.

    Raises:
        ConfigError: no such preset or field, or a value out of range.
    """
    if preset not in PRESETS:
        raise ConfigError(f"preset {preset!r}: expected one of {', '.join(PRESETS)}.")
    changed = {name: value for name, value in changes.items() if value is not None}
    return given(SensorSettings, PRESETS[preset], changed)


class SensorSimulator:
    """An event camera that is shown one picture after the other.

    Between two pictures each pixel's filtered log-intensity is linear in time, so that events have
    the exact times at which it crosses a threshold (Rebecq et al., ESIM, 2018). Equal seeds give
    equal events, whatever the number of threads.
    """

    contrast_on: Float[np.ndarray, "H W"]
    """Threshold of each pixel for ON events, as drawn."""
    contrast_off: Float[np.ndarray, "H W"]
    """Threshold of each pixel for OFF events, positive."""
    leak_hz: Float[np.ndarray, "H W"]
    """Leak events per second of each pixel."""
    hot_hz: Float[np.ndarray, "H W"]
    """Additional events per second of each pixel; zero but for hot pixels."""

    def __init__(
        self, width: int, height: int, settings: SensorSettings | None = None, seed: int = 0
    ) -> None:
        if not (1 <= width <= 65_536 and 1 <= height <= 65_536):
            raise DataError(f"a sensor of {width}x{height} pixels: expected 1 to 65536 each way.")
        self.width = width
        self.height = height
        self.settings = settings = settings or SensorSettings()
        self.seed = seed
        self._time_us: int | None = None
        rng = np.random.Generator(np.random.Philox(np.random.SeedSequence(seed)))
        draw = rng.standard_normal((3, height, width), dtype=np.float32)
        on, off = (
            (contrast * (1 + settings.contrast_mismatch * spread)).clip(LOWEST_CONTRAST)
            for contrast, spread in zip(
                (settings.contrast_on, settings.contrast_off), draw[:2], strict=True
            )
        )
        uniform = rng.random((2, height, width), dtype=np.float32)
        self.contrast_on, self.contrast_off = on.astype(np.float32), off.astype(np.float32)
        self.leak_hz = (settings.leak_hz * 10 ** (settings.leak_spread * draw[2])).astype(
            np.float32
        )
        hot = uniform[0] < settings.hot_pixel_fraction
        self.hot_hz = (settings.hot_pixel_hz * hot).astype(np.float32)
        leaks, has_hot = bool(settings.leak_hz), bool(self.hot_hz.any())
        self._sensor = native_for("The event simulator").Sensor(
            self.contrast_on,
            self.contrast_off,
            # one ON event each time that the drift has covered the pixel's threshold
            self.leak_hz * self.contrast_on if leaks else None,
            # a pixel that leaks is met anywhere on its way to the next event
            uniform[1] * self.contrast_on if leaks else None,
            self.hot_hz if has_hot else None,
            settings.response == "lin-log",
            settings.log_eps,
            settings.cutoff_hz,
            settings.shot_hz,
            settings.refractory_us,
            int(np.random.SeedSequence([seed, 1]).generate_state(1, np.uint64)[0]),
        )

    def step(
        self, linear_luma: Float[np.ndarray, "H W"] | Float[Tensor, "H W"], time_us: int
    ) -> EventStream:
        """Events between the picture before and this one, by time, then by pixel.

        ``linear_luma`` is linear light, 1 = full scale; below 0 counts as 0. The first picture only
        tells each pixel what it sees and gives no events. A `DataError` where times do not ascend,
        or where the picture has another size or is not finite; the sensor then stays as it was.
        """
        time_us = int(time_us)
        if isinstance(linear_luma, Tensor):
            linear_luma = linear_luma.detach().cpu().numpy()
        luma = np.ascontiguousarray(linear_luma, dtype=np.float32)
        if luma.shape != (self.height, self.width):
            raise DataError(
                f"the picture at {time_us} us has shape {luma.shape}, expected luma of shape "
                f"{(self.height, self.width)}; use evsplat.pictures.luminance for colour."
            )
        last = self._time_us
        if last is not None and not last < time_us < last + _LONGEST_STEP_US:
            raise DataError(
                f"the picture at {time_us} us follows one at {last} us; expected a later time, by "
                "less than 35 minutes."
            )
        if not self._sensor.step(luma, time_us, torch.get_num_threads()):
            raise DataError(f"the picture at {time_us} us holds a value that is not finite.")
        self._time_us = time_us
        count = self._sensor.count
        events = EventStream(
            np.empty(count, dtype=np.int64),
            np.empty(count, dtype=np.uint16),
            np.empty(count, dtype=np.uint16),
            np.empty(count, dtype=np.int8),
        )
        self._sensor.take(events.t, events.x, events.y, events.p)
        return events


def simulate_events(
    frames: Iterable[tuple[int, Float[Tensor, "..."] | Float[np.ndarray, "..."]]],
    settings: SensorSettings | None = None,
    seed: int = 0,
) -> Iterator[EventStream]:
    """Events of timed pictures (microseconds; linear light (H, W) or (H, W, 3)), step by step.

    One slice for each picture but the first, in order, so that memory does not grow with the
    number of pictures. Equal seeds give equal events.

    Raises:
        DataError: as of `SensorSimulator.step`, when its slice is asked for.
    """
    sensor: SensorSimulator | None = None
    for time_us, picture in frames:
        light = torch.as_tensor(picture)
        luma = luminance(light) if light.ndim == 3 else light
        if sensor is None:
            height, width = luma.shape
            sensor = SensorSimulator(width, height, settings, seed)
            sensor.step(luma, time_us)
        else:
            yield sensor.step(luma, time_us)
