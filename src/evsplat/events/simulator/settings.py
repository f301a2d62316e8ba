"""Settings of the simulated event camera; every number of a preset has a source in the docs."""

from dataclasses import asdict, dataclass
from typing import Annotated, Any, Literal

from evsplat.config import AtLeast, Within, check
from evsplat.errors import ConfigError
from evsplat.options.declare import Sensor, given

LOWEST_CONTRAST = 0.01
"""Thresholds, drawn ones too, stay at or above this: one 8-bit level near white is 0.009."""


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
    """A preset with some fields changed; those given as None stay."""
    if preset not in PRESETS:
        raise ConfigError(f"preset {preset!r}: expected one of {', '.join(PRESETS)}.")
    changed = {name: value for name, value in changes.items() if value is not None}
    return given(SensorSettings, PRESETS[preset], changed)
