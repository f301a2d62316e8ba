"""What an avatar loses against its model: both drawn on the test frames."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from tqdm import tqdm

from evsplat.capture import Camera, Capture
from evsplat.errors import DataError
from evsplat.export.avatar.figure import Figure
from evsplat.methods.reconstruction import Bakeable
from evsplat.render import Splats, render
from evsplat.similarity import psnr


@dataclass(frozen=True)
class Psnr:
    """Means over frames, dB."""

    person: float
    """On the person's pixels."""
    full: float
    """On the full frame."""


@dataclass(frozen=True)
class Loss:
    """Model and avatar on the test frames, in the same scene, drawn by the same rasteriser."""

    frames: int
    keeps_light: bool
    """Whether the avatar has the light, which a method may know."""
    avatar_to_model: Psnr
    model_to_truth: Psnr | None
    """None where the capture has no sharp truth."""
    avatar_to_truth: Psnr | None

    def sentence(self) -> str:
        """The loss in words, with its figures."""
        dropped = "non-rigid motion, colour" + ("" if self.keeps_light else ", light")
        said = (
            f"Dropped: what poses do beyond skinning ({dropped}). On the "
            f"person's pixels of {self.frames} test frames the avatar is "
            f"{self.avatar_to_model.person:.2f} dB PSNR from the model"
        )
        if self.model_to_truth is None or self.avatar_to_truth is None:
            return said + "."
        before, after = self.model_to_truth.person, self.avatar_to_truth.person
        return (
            f"{said}; against the sharp truth {before:.2f} dB becomes {after:.2f} dB "
            f"({after - before:+.2f})."
        )


@torch.no_grad()
def measure_loss(source: Bakeable, figure: Figure, capture: Capture) -> Loss:
    """Draw both on the test frames, or on all frames where none is held out."""
    frames = [f for f in capture.frames if f.split == "test"] or list(capture.frames)
    rows: dict[str, list[Psnr]] = {"avatar": [], "model_truth": [], "avatar_truth": []}
    for frame in tqdm(frames, unit="frame", desc="avatar against model", dynamic_ncols=True):
        camera = capture.camera(frame)
        person, scene = source.splats(camera, [frame.mid_us])
        skinned = figure.gaussians.posed(source.pose([frame.mid_us])[1])
        model, model_share = _draw(person, scene, camera, source.low_pass)
        avatar, avatar_share = _draw(skinned, scene, camera, source.low_pass)
        mask = capture.mask(frame)
        pixels = torch.maximum(model_share, avatar_share) > 0.5 if mask is None else mask > 0.5
        if not bool(pixels.any()):
            continue

        def of(image: Tensor, reference: Tensor, pixels: Tensor = pixels) -> Psnr:
            return Psnr(float(psnr(image, reference, mask=pixels)), float(psnr(image, reference)))

        rows["avatar"].append(of(avatar, model))
        if frame.sharp is not None:
            truth = capture.sharp(frame)
            rows["model_truth"].append(of(model, truth))
            rows["avatar_truth"].append(of(avatar, truth))
    between = _mean(rows["avatar"])
    if between is None:
        raise DataError(f"{capture.path}: the person is in none of the test frames.")
    return Loss(
        len(rows["avatar"]),
        figure.gaussians.light is not None,
        between,
        _mean(rows["model_truth"]),
        _mean(rows["avatar_truth"]),
    )


def _draw(
    person: Splats, scene: Splats, camera: Camera, low_pass: float
) -> tuple[Float[Tensor, "H W 3"], Float[Tensor, "H W"]]:
    """Picture and the person's share of it."""
    layers = [_on_cpu(layer) for layer in (person, scene)]
    image = render(layers[0], camera, static=layers[1], low_pass=low_pass).image[0].clamp(0, 1)
    return image[..., :3], image[..., 3]


def _on_cpu(splats: Splats) -> Splats:
    given = {name: value for name, value in vars(splats).items() if value is not None}
    return Splats(**{name: value.cpu() for name, value in given.items()})


def _mean(values: list[Psnr]) -> Psnr | None:
    if not values:
        return None
    count = len(values)
    return Psnr(sum(v.person for v in values) / count, sum(v.full for v in values) / count)
