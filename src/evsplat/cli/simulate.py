"""``evsplat simulate``: events of an ordinary video."""

from pathlib import Path
from typing import Annotated, Literal

import tyro

from evsplat.cli.options import option


def simulate(
    source: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SOURCE")],
    /,
    *,
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")],
    preset: Literal["clean", "davis346", "dvxplorer", "evk4"] = "clean",
    contrast: Annotated[float | None, option("C", default="the preset's")] = None,
    overrides: Annotated[
        tuple[str, ...], option("[KEY=VALUE ...]", default="none", name="set")
    ] = (),
    source_fps: Annotated[float | None, option("HZ", default="the video's own")] = None,
    transfer: Literal["power", "srgb", "linear"] = "power",
    seed: int = 0,
) -> None:
    """Write the events that an event camera would have sent, seeing a video.

    Args:
        source: A video, or a folder of pictures in the order of their names; 200 a second or more,
            as light is taken to change evenly between two.
        out: Event file to write, such as events.h5.
        preset: Event camera; clean has no noise (docs/simulator.md).
        contrast: Threshold of both polarities, in natural logarithm of light.
        overrides: Sensor settings to change, such as shot_hz=5 or contrast_off=0.3.
        source_fps: Rate at which the pictures were taken; a folder needs it.
        transfer: From coded values to light: exponent 2.2, sRGB's curve, or as they are.
        seed: Of everything random in the sensor.
    """
    from evsplat.config import from_dict, override, to_dict
    from evsplat.events import SensorSettings, sensor_settings
    from evsplat.footage.simulate import simulate as simulate_footage

    values = to_dict(sensor_settings(preset, contrast_on=contrast, contrast_off=contrast))
    settings = from_dict(SensorSettings, override(values, overrides), where="--set")
    count = simulate_footage(
        source, out, settings=settings, fps=source_fps, transfer=transfer, seed=seed
    )
    print(f"written: {out} ({count:,} events)")
