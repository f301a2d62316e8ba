"""Options of ``evsplat synthesize``, and its named recipes."""

from dataclasses import asdict, dataclass
from typing import Annotated, Literal

from evsplat.config import Above, AtLeast, Within
from evsplat.errors import ConfigError
from evsplat.options.declare import Sensor, Transfer, check_options, option

Interpolation = Literal["flow", "super-slomo", "none"]


@dataclass(frozen=True)
class Recipe:
    """Settings that a data set of the paper is made with."""

    interpolation: Interpolation
    duty: float
    contrast: float | None = None


_NONE = Recipe("flow", duty=0.75)
# The paper names Super SloMo but neither factor nor exposure nor sensor. Read as: every source
# picture is the middle of an exposure as long as the time between two, of eight sub-frames.
_PAPER = Recipe("super-slomo", duty=1.0, contrast=0.2)
# The recorded events of MMHPSD carry no polarity, so they are simulated as well.
RECIPES = {"zju-mocap-blur": _PAPER, "mmhpsd-blur": _PAPER}
"""How the paper's data sets are made from ZJU-MoCap and MMHPSD, by name."""
_EXPOSURES = ("exposure_us", "duty", "subframes")


@dataclass(frozen=True)
class SynthesisSettings:
    """How blurry frames and events are made; at most one of the three exposures is given.

    What a recipe says is filled in where nothing else is given.
    """

    recipe: Annotated[
        Literal["zju-mocap-blur", "mmhpsd-blur"] | None, option("NAME", default="none")
    ] = None
    """zju-mocap-blur or mmhpsd-blur."""
    fps: Annotated[float | None, Above(0), option("HZ", default="the source's")] = None
    """Blurry frames per second."""
    exposure_us: Annotated[int | None, Above(1), option("US", default="by --duty")] = None
    """Length of the exposures."""
    duty: Annotated[float | None, Above(0), option("SHARE", default="0.75")] = None
    """Their share of the time between frames."""
    subframes: Annotated[int | None, Above(0), option("K", default="by --duty")] = None
    """Frames are means of K sub-frames."""
    upsample: Annotated[int, AtLeast(1), option("N")] = 8
    """Sub-frames per source picture."""
    interpolation: Annotated[Interpolation | None, option("KIND", default="flow")] = None
    """flow, super-slomo or none."""
    transfer: Annotated[Transfer, option("CURVE")] = "power"
    """Values to light: power (2.2), srgb or linear."""
    sensor: Annotated[Sensor, option("PRESET")] = "clean"
    """Event camera, as of 'evsplat simulate'."""
    contrast: Annotated[float | None, AtLeast(0.01), option("C", default="the sensor's")] = None
    """Event threshold."""
    seed: Annotated[int, option("N")] = 0
    """Seed of all noise."""
    read_noise: Annotated[float, Within(0, 1), option("SIGMA")] = 0.0
    """Noise of frames, in linear light."""
    events: Annotated[Literal["simulate", "source", "none"], option("WHICH")] = "simulate"
    """simulate, source or none."""
    split: Annotated[Literal["modulo", "source"], option("HOW")] = "modulo"
    """modulo or source."""

    def __post_init__(self) -> None:
        check_options(self)
        exposures = [f"--{n.replace('_', '-')}" for n in _EXPOSURES if getattr(self, n) is not None]
        if len(exposures) > 1:
            raise ConfigError(f"{' and '.join(exposures)}: give one length of the exposures.")
        recipe = _NONE if self.recipe is None else RECIPES[self.recipe]
        for name, value in asdict(recipe).items():
            if getattr(self, name) is None and not (name == "duty" and exposures):
                object.__setattr__(self, name, value)

    @property
    def factor(self) -> int:
        """Sub-frames per source picture that are really made."""
        return 1 if self.interpolation == "none" else self.upsample
