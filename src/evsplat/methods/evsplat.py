"""Method `evsplat`: the paper's model seen by a camera that integrates, in light that falls on it.

What it adds to `paper`: the blurry frame is the mean of renders over its exposure; events are
compared at any time and with their amplitude, by learned contrast thresholds; the person's colour
depends on how the surface is turned and where it stands; the person casts shadows on the scene.
"""

from dataclasses import dataclass, field

import torch

from evsplat.capture import Capture
from evsplat.deform.human_scene import DeformConfig
from evsplat.methods.composition import Composition
from evsplat.methods.paper import Build, EventConfig, PaperConfig
from evsplat.objectives import (
    ContrastThresholds,
    EventWindows,
    Exposure,
    Objective,
    motion_px,
    renders_for,
)

UNKNOWN_THRESHOLD = 0.2
"""Contrast threshold to start from where the capture does not say one."""


@dataclass(frozen=True)
class ExposureConfig:
    """The blur of a frame."""

    px_per_render: float = 3.0
    """How far, in pixels, the body moves between neighbouring renders."""
    most_renders: int = 7
    """Upper bound of renders in an exposure, odd."""


@dataclass(frozen=True)
class WindowConfig:
    """Event windows."""

    start: float = 750
    """First nominal iteration."""
    eps: float = 0.004
    """Added to linear luminance: darker than this a sensor sees nothing."""
    reach: float = 0.5
    """How far before or after an exposure windows reach, in frame intervals."""


@dataclass(frozen=True)
class EvsplatConfig(PaperConfig):
    """All settings of method `evsplat`; those of `paper` that it shares keep their names."""

    exposure: ExposureConfig = field(default_factory=ExposureConfig)
    windows: WindowConfig = field(default_factory=WindowConfig)
    event: EventConfig = field(default_factory=lambda: EventConfig(weight=0.2))
    deform: DeformConfig = field(
        default_factory=lambda: DeformConfig(networks_once=True, shading=True, shadow_lights=4)
    )


def compose(
    config: EvsplatConfig,
    capture: Capture,
    seed: int,
    *,
    device: torch.device | str = "cpu",
    fit: bool = True,
) -> Composition:
    """Put the method together for one capture; see `evsplat.methods.paper.compose`."""
    build = Build.start(config, capture, seed, device=device, fit=fit)
    renders = {
        frame.name: renders_for(
            motion_px(capture, build.track, frame),
            config.exposure.px_per_render,
            config.exposure.most_renders,
        )
        for frame in capture.train_frames
    }
    observed: list[Objective] = [Exposure(capture, renders, build.generator)]
    if capture.events is not None and config.event.weight != 0.0:
        on, off = capture.contrast_threshold or (UNKNOWN_THRESHOLD, UNKNOWN_THRESHOLD)
        thresholds = ContrastThresholds(on, off).to(device)
        build.model.sensor = thresholds
        windows = config.windows
        observed.append(
            EventWindows(
                capture,
                thresholds,
                build.generator,
                start=windows.start,
                eps=windows.eps,
                reach=windows.reach,
            )
        )
    return build.composition(observed)
