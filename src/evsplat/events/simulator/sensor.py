"""The simulated sensor: thresholds drawn once, then one compiled step per picture."""

from collections.abc import Iterable, Iterator

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from evsplat.compiled import import_error, native
from evsplat.errors import BackendError, DataError
from evsplat.events.simulator.settings import LOWEST_CONTRAST, SensorSettings
from evsplat.events.stream import EventStream
from evsplat.pictures.light import luminance

_LONGEST_STEP_US = 2**31


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
        if native is None:
            raise BackendError(
                f"The event simulator is not built ({import_error}); install evsplat with pip."
            )
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
        self._sensor = native.Sensor(
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
    number of pictures.
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
