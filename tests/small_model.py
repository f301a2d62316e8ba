"""Every method so small that a training step takes milliseconds."""

import importlib
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from evsplat.capture import Capture, load_capture
from evsplat.config import override
from evsplat.methods import TRAINABLE, Composition, Purpose, method_config, poses

_PERSON = ("human.count=120", "densify.max_human=150")
_NETWORKS = (
    "networks.width=16",
    "networks.colour_width=16",
    "terms.skinning_prefit_steps=3",
    "terms.isometry_samples=64",
)
SMALL = {
    "avatar3dgs": (*_PERSON, *_NETWORKS, "terms.perceptual=none"),
    "avatar3dgs_semantic": (
        *_PERSON,
        "scene.backdrop_stride_px=4",
        *_NETWORKS,
        "terms.perceptual=none",
    ),
    # The fill takes as long as all else of a short training; tests that ask about it switch it on.
    "evsplat": (*_PERSON, "scene.prefit_steps=3", "width=16", "fill=0"),
    "hugs": (
        "human.count=80",
        "scene.cube_count=600",
        "channels=8",
        "resolution=16",
        "fit_steps=2",
    ),
    "paper": (*_PERSON, "scene.prefit_steps=3", *_NETWORKS),
}
"""Settings by method."""
FILL = "fill=0.001"
"""What `evsplat` decides at its end where little was seen, as by default."""
_UNREAD = {
    "scene.kind=random_cube": ("scene.prefit_steps", "scene.backdrop_stride_px"),
    "scene.kind=median_backdrop": ("scene.cube_count",),
}


def small(method: str, *settings: str) -> tuple[str, ...]:
    """Settings of the small ``method`` with others over them, and none that these leave unread."""
    left_out = {name for one in settings for name in _UNREAD.get(one, ())}
    left_out |= {one.partition("=")[0] for one in settings}
    return (*(one for one in SMALL[method] if one.partition("=")[0] not in left_out), *settings)


def small_config(method: str, *settings: str) -> Any:
    """The configuration of the small ``method``."""
    return method_config(method, override({}, small(method, *settings)), where="test")


def few_descent_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Before training poses are drawn a little; tests/posing/test_refine.py asks how well."""
    for how in ("refine", "judge"):
        monkeypatch.setattr(poses, how, partial(getattr(poses, how), steps=(4, 4), discs=100))
    # The package has a function of the module's name.
    drawing = [importlib.import_module(f"evsplat.posing.{name}") for name in ("descent", "refine")]
    for module in drawing:
        monkeypatch.setattr(module, "LOOK_STEPS", 4)
    monkeypatch.setattr(drawing[1], "_LAST_STEPS", 4)


def built(
    method: str,
    capture: Capture | Path,
    *settings: str,
    seed: int = 0,
    device: str = "cpu",
    purpose: Purpose = "resume",
) -> Composition:
    """The small ``method`` put together, by default without the fits before the first step."""
    if not isinstance(capture, Capture):
        capture = load_capture(capture)
    config = small_config(method, *settings)
    return TRAINABLE[method].build(
        config, capture.for_training(config.policy), seed, device=device, purpose=purpose
    )
