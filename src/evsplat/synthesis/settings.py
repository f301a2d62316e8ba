"""What is made of sharp footage, and how: the settings and the named recipes."""

import math
from dataclasses import asdict, dataclass, fields, replace
from difflib import get_close_matches
from typing import Any, Literal, get_args

from evsplat.errors import ConfigError
from evsplat.events import PRESETS, SensorSettings, sensor_settings
from evsplat.pictures.light import Transfer

Interpolation = Literal["flow", "super-slomo", "none"]
Events = Literal["simulate", "source", "none"]
Split = Literal["modulo", "source"]

DEFAULT_DUTY = 0.75


@dataclass(frozen=True)
class SynthesisSettings:
    """How blurry frames and events are made; at most one of the three exposures is given."""

    interpolation: Interpolation = "flow"
    """How pictures between the source's are made; ``none`` takes the source's alone."""
    upsample: int = 8
    """Sub-frames per source picture; the source's own is the first of them."""
    fps: float | None = None
    """Blurry frames per second; None: every source picture is the middle of one."""
    exposure_us: int | None = None
    """Length of the exposures."""
    duty: float | None = None
    """Length of the exposures as a share of the time from frame to frame; 0.75 where none of the
    three is given."""
    subframes: int | None = None
    """Length of the exposures in sub-frames: a frame is the plain mean of so many."""
    transfer: Transfer = "power"
    """Between the source's values and linear light, where pictures are averaged."""
    sensor: str = "clean"
    """Preset of the simulated event sensor."""
    contrast: float | None = None
    """Contrast threshold of both polarities; None: the preset's."""
    seed: int = 0
    """Of the sensor's pixels and of the read noise."""
    read_noise: float = 0.0
    """Standard deviation of noise on blurry frames, in linear light of full scale 1."""
    events: Events = "simulate"
    """``source`` keeps the events of a source capture."""
    split: Split = "modulo"
    """``modulo``: frames whose index modulo 10 is 7, 8 or 9 are test (paper); ``source`` keeps the
    split of a source capture."""

    def __post_init__(self) -> None:
        for name, values in (
            ("interpolation", get_args(Interpolation)),
            ("transfer", get_args(Transfer)),
            ("events", get_args(Events)),
            ("split", get_args(Split)),
            ("sensor", tuple(PRESETS)),
        ):
            if getattr(self, name) not in values:
                raise ConfigError(
                    f"{name} {getattr(self, name)!r}: expected one of {', '.join(values)}."
                )
        for name, above in (("fps", 0.0), ("exposure_us", 1.0), ("duty", 0.0), ("subframes", 0.0)):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > above):
                raise ConfigError(f"{name} {value:g}: expected a number above {above:g}.")
        if self.upsample < 1:
            raise ConfigError(f"upsample {self.upsample}: expected a whole number of at least 1.")
        if not 0 <= self.read_noise <= 1:
            raise ConfigError(f"read_noise {self.read_noise:g}: expected 0 to 1 of full scale.")
        given = [name for name in _EXPOSURES if getattr(self, name) is not None]
        if len(given) > 1:
            raise ConfigError(f"{' and '.join(given)}: give one length of the exposures.")
        _ = self.sensor_settings

    @property
    def factor(self) -> int:
        """Sub-frames per source picture that are really made."""
        return 1 if self.interpolation == "none" else self.upsample

    @property
    def sensor_settings(self) -> SensorSettings:
        """The simulated sensor."""
        return sensor_settings(self.sensor, contrast_on=self.contrast, contrast_off=self.contrast)

    def to_dict(self) -> dict[str, Any]:
        """As JSON holds it."""
        return asdict(self)


_EXPOSURES = ("exposure_us", "duty", "subframes")

# The paper names Super SloMo but neither factor nor exposure nor sensor. Read as: every source
# picture is the middle of an exposure as long as the time between two, of eight sub-frames.
_PAPER = SynthesisSettings(
    interpolation="super-slomo", upsample=8, duty=1.0, transfer="power", contrast=0.2
)
RECIPES: dict[str, SynthesisSettings] = {
    "zju-mocap-blur": _PAPER,
    # the recorded events of MMHPSD carry no polarity
    "mmhpsd-blur": _PAPER,
}
"""How the paper's data sets are made from ZJU-MoCap and MMHPSD, by name."""


def synthesis_settings(recipe: str | None = None, **changes: Any) -> SynthesisSettings:
    """A recipe (or the defaults) with some settings changed; those given as None stay."""
    if recipe is not None and recipe not in RECIPES:
        raise ConfigError(f"recipe {recipe!r}: expected one of {', '.join(RECIPES)}.")
    base = SynthesisSettings() if recipe is None else RECIPES[recipe]
    known = [field.name for field in fields(SynthesisSettings)]
    for name in changes:
        if name not in known:
            near = get_close_matches(name, known, 1)
            hint = f" Did you mean {near[0]}?" if near else ""
            raise ConfigError(f"{name}: no such setting of the synthesis.{hint}")
    given = {name: value for name, value in changes.items() if value is not None}
    if any(name in given for name in _EXPOSURES):
        # the recipe's length of the exposures makes way for the one given
        given = {name: None for name in _EXPOSURES} | given
    return replace(base, **given)
