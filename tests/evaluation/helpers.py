"""Reconstructions that need no training."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch

from evsplat.capture import Camera, Capture
from evsplat.methods.reconstruction import Parts, Rendering


class TruthWithNoise:
    """Draws the sharp truth (nearest in time), plus noise that is the same at every call."""

    name = "truth_with_noise"

    def __init__(self, capture: Capture, noise: float = 0.0) -> None:
        self._capture = capture
        self._noise = noise

    def render(self, camera: Camera, times_us: Sequence[int], *, parts: Parts = "all") -> Rendering:
        """Frames for the recording camera, novel views for the others."""
        rgb = torch.stack([self._picture(camera, time) for time in times_us])
        generator = torch.Generator().manual_seed(1)
        rgb = rgb + self._noise * torch.randn(rgb.shape[1:], generator=generator)
        return Rendering(rgb, torch.ones(rgb.shape[:3]), torch.zeros(rgb.shape[:3]))

    def _picture(self, camera: Camera, time_us: int) -> torch.Tensor:
        capture = self._capture
        names = {view.camera for view in capture.novel_views}
        novel = [name for name in names if capture.cameras[name] is camera]
        if novel:
            views = [view for view in capture.novel_views if view.camera == novel[0]]
            return capture.novel_image(min(views, key=lambda view: abs(view.time_us - time_us)))
        frame = min(capture.frames, key=lambda frame: abs(frame.mid_us - time_us))
        return capture.image(frame) if frame.sharp is None else capture.sharp(frame)


def edit(path: Path, change: Callable[[dict[str, Any]], None]) -> Path:
    """Apply ``change`` to the capture.json of ``path``."""
    file = path / "capture.json"
    document = json.loads(file.read_text())
    change(document)
    file.write_text(json.dumps(document))
    return path


def drop(*keys: str) -> Callable[[dict[str, Any]], None]:
    """A change that removes ``keys`` from every frame."""

    def change(document: dict[str, Any]) -> None:
        for frame in document["frames"]:
            for key in keys:
                frame.pop(key)

    return change
