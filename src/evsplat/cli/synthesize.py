"""``evsplat synthesize``: make a capture of sharp footage."""

from pathlib import Path
from typing import Annotated, Literal

import tyro

from evsplat.cli.options import Flag, option


def synthesize(
    source: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SOURCE")],
    /,
    *,
    out: Annotated[Path, tyro.conf.arg(metavar="CAPTURE")],
    recipe: Annotated[
        Literal["zju-mocap-blur", "mmhpsd-blur"] | None, option("NAME", default="none")
    ] = None,
    fps: Annotated[float | None, option("HZ", default="the source's")] = None,
    exposure_us: Annotated[int | None, option("US", default="by --duty")] = None,
    duty: Annotated[float | None, option("SHARE", default="0.75")] = None,
    subframes: Annotated[int | None, option("K", default="by --duty")] = None,
    upsample: Annotated[int | None, option("N", default="8")] = None,
    interpolation: Annotated[
        Literal["flow", "super-slomo", "none"] | None, option("KIND", default="flow")
    ] = None,
    weights: Annotated[Path | None, option("FILE", default="in torch's hub")] = None,
    transfer: Annotated[
        Literal["power", "srgb", "linear"] | None, option("CURVE", default="power")
    ] = None,
    sensor: Annotated[str | None, option("PRESET", default="clean")] = None,
    contrast: Annotated[float | None, option("C", default="the sensor's")] = None,
    seed: Annotated[int | None, option("N", default="0")] = None,
    read_noise: Annotated[float | None, option("SIGMA", default="0")] = None,
    events: Annotated[
        Literal["simulate", "source", "none"] | None, option("WHICH", default="simulate")
    ] = None,
    split: Annotated[Literal["modulo", "source"] | None, option("HOW", default="modulo")] = None,
    source_fps: Annotated[float | None, option("HZ", default="the video's")] = None,
    body: Annotated[Path | None, option("NPZ", default="none")] = None,
    camera: Annotated[Path | None, option("JSON", default="a nominal one")] = None,
    overwrite: Flag = False,
) -> None:
    """Make a capture of sharp footage: blur and events (docs/synthesize.md).

    Args:
        source: Video, folder of pictures, or capture with sharp frames.
        out: New capture folder.
        recipe: zju-mocap-blur or mmhpsd-blur.
        fps: Blurry frames per second.
        exposure_us: Length of the exposures.
        duty: Their share of the time between frames.
        subframes: Frames are means of K sub-frames.
        upsample: Sub-frames per source picture.
        interpolation: flow, super-slomo or none.
        weights: Super SloMo's checkpoint.
        transfer: power (2.2), srgb or linear.
        sensor: Of 'evsplat simulate'.
        contrast: Event threshold.
        seed: Of all noise.
        read_noise: Of frames, in linear light.
        events: simulate, source or none.
        split: modulo or source.
        source_fps: Rate of shooting.
        body: Poses as in body.npz.
        camera: As in capture.json.
        overwrite: Replace a capture at CAPTURE.
    """
    from evsplat.synthesis import synthesize as make

    path = make(
        source,
        out,
        recipe=recipe,
        source_fps=source_fps,
        body=body,
        camera=camera,
        weights=weights,
        overwrite=overwrite,
        fps=fps,
        exposure_us=exposure_us,
        duty=duty,
        subframes=subframes,
        upsample=upsample,
        interpolation=interpolation,
        transfer=transfer,
        sensor=sensor,
        contrast=contrast,
        seed=seed,
        read_noise=read_noise,
        events=events,
        split=split,
    )
    print(f"written: {path}\nlook at it with: evsplat inspect {path}")
