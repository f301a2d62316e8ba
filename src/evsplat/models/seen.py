"""What training frames showed of each of the person's Gaussians."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from evsplat.camera import Camera
from evsplat.capture import TrainingCapture
from evsplat.models.at_rest import SkinnedGaussians
from evsplat.models.layers import Layers
from evsplat.models.model import Model
from evsplat.models.stored import stored
from evsplat.neighbours import nearest
from evsplat.probes import random_signs
from evsplat.render import Splats, render

LITTLE_PX = 0.3
"""A Gaussian with smaller `Seen.squares` counts as little seen."""
MOST_FRAMES = 240
"""Training frames that are looked at, evenly spread over a longer recording."""
_DRAWS = 4
"""Random signs per frame that the squares are estimated with."""
_NEIGHBOURS = 8


@dataclass(frozen=True, eq=False)
class Seen:
    """Sums over the pixels of all training frames, per Gaussian of the person.

    The share of a pixel is transmittance x alpha. What shines through others has small shares, in
    as many pixels as there are: their squares tell it from what is really seen.
    """

    weight: Float[Tensor, " H"]
    """Sum of the shares, pixels."""
    squares: Float[Tensor, " H"]
    """Sum of their squares, pixels; an estimate without bias."""
    directions: Float[Tensor, "H 3"]
    """Sum of the unit directions to the cameras, each times its frame's share; canonical axes.

    Its length is ``weight`` where all frames looked from one side.
    """

    def certainty(self) -> Float[Tensor, " H"]:
        """From 0, never seen, to 1; one half at `LITTLE_PX`."""
        return self.squares / (self.squares + LITTLE_PX)

    def little(self) -> Bool[Tensor, " H"]:
        """True where a Gaussian was little seen."""
        return self.squares < LITTLE_PX

    @classmethod
    def of(cls, tensors: Mapping[str, Tensor], count: int) -> "Seen | None":
        """From the tensors by their names, or None where there are none.

        Raises:
            ValueError: They are not those of ``count`` Gaussians, or not finite.
        """
        return stored(cls, "what was seen", tensors, count, directions=3)


def seen_by(model: Model, capture: TrainingCapture) -> Seen:
    """What the training frames showed of the person as ``model`` draws it at their middles.

    Of more than `MOST_FRAMES` some stand for all, so that the end of an hour's training is no later
    than that of a minute's.

    A picture's derivative by a Gaussian's colour is its share of the pixels. The gradient of the
    sum over all pixels is thus the sum of the shares, and that of a sum with random signs has the
    sum of their squares as its mean square (Hutchinson 1990).
    """
    generator = torch.Generator().manual_seed(0)
    sums: list[Tensor] = []
    frames = capture.train_frames[:: -(-len(capture.train_frames) // MOST_FRAMES)]
    for frame in frames:
        camera = capture.camera(frame).to(model.device)
        with torch.no_grad():
            layers = model.at([frame.mid_us], camera.center(), hard_semantics=True)
        shares = shares_in(layers, camera, generator)
        weight, squares = shares[:, 0], shares[:, 1:].square().mean(1)
        toward = normalize(camera.center() - layers.human.means[0], dim=-1)
        back = layers.transforms[0, :, :3, :3].transpose(-1, -2)
        directions = normalize((back @ toward[..., None])[..., 0], dim=-1) * weight[:, None]
        values = [weight, squares, directions]
        sums = [a + b for a, b in zip(sums, values, strict=True)] if sums else values
    each = len(capture.train_frames) / len(frames)
    return Seen(*(each * value.detach() for value in sums))


def shares_in(
    layers: Layers, camera: Camera, generator: torch.Generator, draws: int = _DRAWS
) -> Float[Tensor, "H K"]:
    """Sums over a picture of the shares of the person's Gaussians at one time.

    The first column is the plain sum, each of the ``draws`` others one with random signs.
    """
    return shares_by(
        lambda values: draw_values(layers, camera, values), layers.human.means, generator, draws
    )


def shares_by(
    drawn: Callable[[Float[Tensor, "1 N K"]], Float[Tensor, "1 H W K"]],
    means: Float[Tensor, "T N 3"],
    generator: torch.Generator,
    draws: int = _DRAWS,
) -> Float[Tensor, "N K"]:
    """`shares_in` of any Gaussians, by what draws a picture of values of theirs."""
    values = means.new_zeros(1, means.shape[1], 1 + draws).requires_grad_()
    image = drawn(values)
    signs = random_signs(image, generator)
    signs[..., 0] = 1
    return transposed(image, values, signs)[0]


def transposed(image: Tensor, values: Tensor, weights: Tensor, *, again: bool = False) -> Tensor:
    """``J^T weights`` of the matrix J by which an image comes from values; ``again`` keeps it.

    As the gradient of a sum: PyTorch imports its compiler, which takes a second, for one that is
    begun with weights of its own (``grad_outputs``).
    """
    return torch.autograd.grad((image * weights).sum(), values, retain_graph=again)[0]


@torch.no_grad()
def facing(layers: Layers, normals: Float[Tensor, "H 3"], camera: Camera) -> Float[Tensor, " H"]:
    """Cosine between the person's surface at the first time and the way to the camera.

    ``normals``: of the surface in canonical space.
    """
    turned = (layers.transforms[0, :, :3, :3] @ normals[..., None])[..., 0]
    toward = camera.center() - layers.human.means[0]
    return (normalize(turned, dim=-1) * normalize(toward, dim=-1)).sum(-1)


def draw_values(
    layers: Layers,
    camera: Camera,
    human: Float[Tensor, "T H C"],
    scene: Float[Tensor, "1 S C"] | None = None,
    kept: Float[Tensor, " H"] | None = None,
) -> Float[Tensor, "T H W C"]:
    """Values of Gaussians drawn instead of their colours, without shadow; the scene's may be 0.

    ``kept``: factors on the person's opacities, which alone of the geometry take a gradient.
    """
    static: Splats | None = layers.scene
    if scene is None:
        static = _hiding(layers, camera)
        if static is not None:
            scene = human.new_zeros(1, static.means.shape[1], human.shape[-1])
    if static is not None and scene is not None:
        static = fixed(static, scene)
    person = fixed(layers.human, human)
    if kept is not None:
        person = replace(person, opacities=person.opacities * kept)
    return render(person, camera, static=static, low_pass=layers.low_pass).image


@torch.no_grad()
def _hiding(layers: Layers, camera: Camera) -> Splats | None:
    """The scene's Gaussians that may hide some of the person, or None where none may.

    Those behind all of the person change nothing of what is seen of them, and are most of a scene.
    """
    if layers.human.means.shape[1] == 0:  # all of the person was pruned, or changed class
        return None
    person, scene = (camera.depth(layer.means) for layer in (layers.human, layers.scene))
    nearer = (scene <= person.max()).any(0)
    if not bool(nearer.any()):
        return None
    static = layers.scene.with_times()
    rows = {name: value[:, nearer] for name, value in vars(static).items() if value is not None}
    return replace(static, **rows)


def fixed(layer: Splats, channels: Tensor) -> Splats:
    """A layer with other channels, whose geometry takes no gradient."""
    geometry = {
        field.name: value.detach().clone()
        for field in fields(layer)
        if field.name != "channels" and (value := getattr(layer, field.name)) is not None
    }
    return replace(layer, **geometry, channels=channels)


def roughness(rest: SkinnedGaussians, seen: Seen) -> dict[str, float | None]:
    """How uneven the person's colours are where little was seen, and where much was.

    Root mean square difference to the colours of the eight nearest Gaussians in canonical space,
    sRGB; ``ratio`` of the first to the second. Speckle makes the little seen rougher than the rest.
    ``little_seen`` is the share of such Gaussians. None where there are none.
    """
    little = seen.little().cpu()
    result: dict[str, float | None] = {"little_seen": float(little.float().mean())}
    rough: list[float | None] = [None, None]
    if len(little) > _NEIGHBOURS:
        _, index = nearest(rest.means, _NEIGHBOURS)
        difference = (rest.rgb[index] - rest.rgb[:, None]).square().mean((1, 2))
        rough = [
            float(difference[rows].mean().sqrt()) if bool(rows.any()) else None
            for rows in (little, ~little)
        ]
    few, many = rough
    ratio = few / many if few is not None and many else None
    return result | {"roughness_little": few, "roughness_much": many, "ratio": ratio}
