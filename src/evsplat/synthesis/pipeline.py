"""`synthesize`: from sharp footage to a capture with blurry frames, sharp truth and events."""

import functools
from collections import deque
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from tqdm import tqdm

import evsplat
from evsplat.body import PoseSource
from evsplat.capture import CaptureWriter
from evsplat.errors import ConfigError, DataError
from evsplat.events import SensorSettings, sensor_settings, simulate_events
from evsplat.footage import TimedPicture, open_footage
from evsplat.options import SynthesisSettings
from evsplat.options.declare import given
from evsplat.pictures.light import Transfer, decode, encode, transfer_shown
from evsplat.synthesis.exposure import Exposure, ExposureMean, Plan, plan_exposures
from evsplat.synthesis.interpolate import Interpolator, Picture
from evsplat.synthesis.sources import CaptureSource, FootageSource, RecordedEvents, Source


def synthesize(
    source: Path | str,
    out: Path | str,
    settings: SynthesisSettings | None = None,
    *,
    source_fps: float | None = None,
    body: Path | str | None = None,
    pose_source: PoseSource | None = None,
    camera: Path | str | None = None,
    weights: Path | str | None = None,
    overwrite: bool = False,
    progress: bool = True,
    **changes: Any,
) -> Path:
    """Make the capture ``out`` of sharp pictures: what a slow shutter and an event sensor see.

    Frames are means over their exposures in linear light; ``sharp`` is the source picture at
    mid-exposure, unchanged; events are simulated from the same sub-frames. Memory does not grow
    with the length of the source, and ``out`` appears whole or not at all.

    Args:
        source: Video file, folder of pictures, or a capture whose frames are sharp.
        out: New capture folder.
        settings: How frames and events are made.
        source_fps: Rate at which footage was shot; needed for a folder of pictures.
        body: body.npz on the clock of the footage (a capture has its own).
        pose_source: Where the poses of ``body`` come from.
        camera: JSON file with one camera as in capture.json (a capture has its own).
        weights: Super SloMo's checkpoint.
        overwrite: Replace a capture at ``out``.
        progress: Show a progress bar.
        changes: Fields of ``settings`` to change, such as ``recipe="mmhpsd-blur"``.

    Returns:
        ``out``.

    Raises:
        ConfigError: settings that do not fit each other or the source.
        DataError: a source that cannot be read, or ``out`` exists.
        WeightsError, BackendError: the interpolation asked for cannot run.
    """
    settings = given(SynthesisSettings, settings, changes)
    source, out = Path(source), Path(out)
    opened = _open(source, source_fps, body, pose_source, camera)
    settings = _with_own_transfer(settings, opened)
    interpolator = _interpolator(settings, _coding(opened, settings), weights)
    plan = plan_exposures(opened.footage.times_us, settings)
    recorded = opened.events() if settings.events == "source" else None
    if settings.split == "source":
        opened.split(0)
    with CaptureWriter(out, overwrite=overwrite) as writer:
        opened.declare(writer, settings.transfer)
        making = _Making(opened, settings, plan, interpolator, writer)
        subframes = making.subframes(progress)
        events = recorded
        if settings.events == "simulate":
            events = _simulated(subframes, settings)
        else:
            deque(subframes, maxlen=0)
        if events is not None:
            writer.set_events(
                events.pieces,
                opened.footage.width,
                opened.footage.height,
                contrast_threshold=events.contrast_threshold,
                simulated=events.simulated,
            )
        opened.complete(writer, making.frames)
        writer.provenance |= _provenance(opened, settings, plan, interpolator)
    return out


class _Making:
    """One pass over the source: frames go to the writer, sub-frames to the event sensor."""

    def __init__(
        self,
        source: Source,
        settings: SynthesisSettings,
        plan: Plan,
        interpolator: Interpolator | None,
        writer: CaptureWriter,
    ) -> None:
        self.frames: dict[str, int] = {}
        """Names and mid-exposures of the frames written so far."""
        self._source, self._settings, self._writer = source, settings, writer
        self._plan, self._interpolator = plan, interpolator
        self._coding = _coding(source, settings)
        self._mean = ExposureMean(plan)
        self._truth: dict[int, TimedPicture] = {}
        self._rng = np.random.default_rng(settings.seed)

    def subframes(self, progress: bool) -> Iterator[tuple[int, Float[np.ndarray, "..."]]]:
        """Times and linear light of all sub-frames; frames are written as they are complete."""
        lights = self._light(progress)
        for time_us, linear in zip(self._plan.subframe_us.tolist(), lights, strict=True):
            for exposure, mean in self._mean.add(linear):
                self._write(exposure, mean)
            yield time_us, linear[..., 0] if linear.shape[-1] == 1 else linear

    def _light(self, progress: bool) -> Iterator[Float[np.ndarray, "H W C"]]:
        """Linear light of all sub-frames; remembers the truth of frames to come."""
        footage, factor = self._source.footage, self._settings.factor
        fractions = [step / factor for step in range(1, factor)]
        middles = {exposure.source for exposure in self._plan.exposures}
        bar = tqdm(
            footage, "synthesize", len(footage.times_us), unit="picture", disable=not progress
        )
        before: Picture | None = None
        for index, timed in enumerate(bar):
            after = _picture(timed.pixels, self._settings.transfer, self._coding)
            if before is not None:
                if before.linear.shape != after.linear.shape:
                    raise DataError(
                        f"{footage.path}: picture {timed.name!r} has shape {timed.pixels.shape}, "
                        "unlike those before it; expected all grey or all colour."
                    )
                if self._interpolator is not None:
                    yield from self._interpolator.between(before, after, fractions)
            if index in middles:
                self._truth[index] = timed
            yield after.linear
            before = after

    def _write(self, exposure: Exposure, mean: Float[np.ndarray, "H W C"]) -> None:
        truth = self._truth.pop(exposure.source)
        settings, source = self._settings, self._source
        if settings.read_noise:
            noise = self._rng.standard_normal(mean.shape, np.float32)
            mean = mean + np.float32(settings.read_noise) * noise
        coded = encode(torch.from_numpy(mean), settings.transfer).clamp(0, 1).numpy()
        kind = truth.pixels.dtype
        self._writer.add_frame(
            truth.name,
            source.camera,
            (coded * np.iinfo(kind).max + 0.5).astype(kind).reshape(truth.pixels.shape),
            (exposure.start_us, exposure.end_us),
            split=source.split(exposure.source) if settings.split == "source" else None,
            sharp=truth.pixels,
            **source.extras(exposure.source),
        )
        self.frames[truth.name] = (exposure.start_us + exposure.end_us) // 2


def _open(
    source: Path,
    source_fps: float | None,
    body: Path | str | None,
    pose_source: PoseSource | None,
    camera: Path | str | None,
) -> Source:
    if not (source / "capture.json").exists():
        footage = open_footage(source, source_fps, rate_option="--source-fps")
        return FootageSource(
            footage,
            None if body is None else Path(body),
            None if camera is None else Path(camera),
            pose_source,
        )
    own = {"source-fps": source_fps, "body": body, "pose-source": pose_source, "camera": camera}
    for name, value in own.items():
        if value is not None:
            raise ConfigError(f"--{name}: {source} is a capture and has its own; leave it out.")
    return CaptureSource(source)


def _with_own_transfer(settings: SynthesisSettings, source: Source) -> SynthesisSettings:
    """The settings with the curve that the source's camera states, if it states one."""
    own = source.transfer
    if own is None:
        return settings
    if settings.transfer not in ("power", own):
        raise ConfigError(
            f"--transfer {settings.transfer}: the camera of {source.footage.path} says {own!r}; "
            "leave the option out or correct the camera."
        )
    return replace(settings, transfer=own)


def _coding(source: Source, settings: SynthesisSettings) -> Transfer:
    """Curve of the values in which motion is looked for.

    Light of a camera that stores it as it stands is coded for that (`transfer_shown`); values that
    ``settings`` alone take for light are averaged as such, and are coded all the same.
    """
    return settings.transfer if source.transfer is None else transfer_shown(source.transfer)


def _interpolator(
    settings: SynthesisSettings, coding: Transfer, weights: Path | str | None
) -> Interpolator | None:
    """None where the source's pictures are all there is."""
    if weights is not None and settings.interpolation != "super-slomo":
        raise ConfigError("--weights: only --interpolation super-slomo has weights.")
    if settings.factor == 1:
        return None
    if settings.interpolation == "super-slomo":
        from evsplat.synthesis.super_slomo import SuperSloMo

        return SuperSloMo(coding, weights)
    from evsplat.synthesis.flow import FlowInterpolator

    return FlowInterpolator()


def _simulated(
    subframes: Iterator[tuple[int, Float[np.ndarray, "..."]]], settings: SynthesisSettings
) -> RecordedEvents:
    """What a simulated sensor tells of the sub-frames, which are taken as events are asked for."""
    sensor = _sensor(settings)
    pieces = simulate_events(subframes, sensor, settings.seed)
    return RecordedEvents(pieces, (sensor.contrast_on, sensor.contrast_off), simulated=True)


def _sensor(settings: SynthesisSettings) -> SensorSettings:
    """The simulated sensor."""
    contrast = settings.contrast
    return sensor_settings(settings.sensor, contrast_on=contrast, contrast_off=contrast)


def _picture(pixels: np.ndarray, transfer: Transfer, coding: Transfer) -> Picture:
    linear = np.atleast_3d(_light_of_values(pixels.dtype, transfer)[pixels])
    if coding == transfer:
        coded = np.atleast_3d(pixels).astype(np.float32) / np.float32(np.iinfo(pixels.dtype).max)
    else:
        coded = encode(torch.from_numpy(linear), coding).numpy()
    return Picture(coded, linear)


@functools.cache
def _light_of_values(kind: np.dtype[Any], transfer: Transfer) -> Float[np.ndarray, "V"]:
    """Linear light of every value that a stored pixel can have."""
    values = torch.arange(np.iinfo(kind).max + 1, dtype=torch.float64)
    return decode(values / values[-1], transfer).numpy().astype(np.float32)


def _provenance(
    source: Source,
    settings: SynthesisSettings,
    plan: Plan,
    interpolator: Interpolator | None,
) -> dict[str, Any]:
    """Every parameter, so that the capture can be made again."""
    first = plan.exposures[0]
    exposure_us = first.end_us - first.start_us
    kind = settings.interpolation if settings.factor > 1 else "no up-sampling"
    events = {
        "simulate": f"events simulated (sensor {settings.sensor}, seed {settings.seed})",
        "source": "events of the source",
        "none": "no events",
    }[settings.events]
    return {
        "text": f"synthesized by evsplat {evsplat.__version__}: exposures of {exposure_us} us, "
        f"means in linear light ({settings.transfer}) of sub-frames ({settings.factor} per source "
        f"picture, {kind}); {events}",
        "synthesis": {
            "evsplat": evsplat.__version__,
            **asdict(settings),
            "exposure_us": exposure_us,
            "sensor_settings": _sensor(settings).to_dict(),
            "interpolation_weights_sha256": getattr(interpolator, "sha256", None),
        },
        "source": source.describe(),
    }
