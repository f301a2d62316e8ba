"""Options of ``evsplat train``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from evsplat.config import Above, AtLeast
from evsplat.errors import ConfigError
from evsplat.options.declare import Device, Flag, NewRun, Threads, Use, check_options, option


@dataclass(frozen=True)
class TrainOptions:
    """How a method is trained on a capture, and where the run goes."""

    method: Annotated[str | None, option("NAME", default="that of --config, or evsplat")] = None
    """Name of the method."""
    out: NewRun = None
    device: Device = "auto"
    """Where to compute; auto takes what the installed rasterisers can use."""
    iterations: Annotated[int | None, AtLeast(1), option("N", default="the method's")] = None
    """Training steps; every schedule is scaled to it."""
    max_minutes: Annotated[float | None, Above(0), option("M", default="no limit")] = None
    """Minutes of training after which to stop gracefully, save and evaluate."""
    resume: Flag = False
    """Go on from the last checkpoint in --out."""
    config: Annotated[Path | None, option("FILE", default="the method's")] = None
    """A config.yaml of an earlier run to start from."""
    overrides: Annotated[
        tuple[str, ...], option("[KEY=VALUE ...]", default="none", name="set")
    ] = ()
    """Settings to change, such as event_weight=0.2; see docs/settings.md."""
    threads: Threads = None
    device_memory_gb: Annotated[
        float | None, AtLeast(0), option("GB", default="a quarter of the free")
    ] = None
    """GPU memory for recorded pictures and event maps."""
    seed: Annotated[int | None, option("S", default="0")] = None
    """Seed of every random number."""
    use: Annotated[Use | None, option("{training,everything}", default="training")] = None
    """everything trains on all that was recorded and holds nothing out for test figures."""

    def __post_init__(self) -> None:
        check_options(self)
        if not self.resume:
            return
        if self.out is None:
            raise ConfigError("--resume needs --out RUN, the run to go on with.")
        own = (self.config, self.seed, self.use)
        if self.overrides or any(value is not None for value in own):
            raise ConfigError(
                "--resume takes the run's own settings; leave out --config, --set, --seed and "
                "--use."
            )
