"""Colours and light where training saw little: neighbours tell them, and what was seen stays.

Adam moves a colour that no picture tells of a third as far as the others, since gradients a
thousand times smaller are still gradients; what the front lets through tells it nonsense. What can
be given no other colour without being missed may become transparent (`transparent`).
"""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from evsplat.camera import Camera
from evsplat.capture import Frame, TrainingCapture
from evsplat.gaussians.surface_graph import closest, harmonic, laplacian, mirror_plane
from evsplat.models.discs.first_colours import EVEN, LEAST, MOST, MOST_FRAMES
from evsplat.models.discs.model import DiscModel
from evsplat.models.discs.transparent import Sight, areas, kept_opacity, off_the_body, prices
from evsplat.models.layers import Layers
from evsplat.models.seen import Seen, draw_values, facing, shares_in, transposed
from evsplat.pictures.light import GAMMA

STEPS = 8
"""Of conjugate gradients, twice."""
MOST_BEHIND, BARELY_PX = 0.25, 0.01
"""Largest difference to what neighbours say where a surface was seen from behind alone; half of it
where the squares of its shares sum to the second: what shines through the front has its colour."""
HUE, BRIGHT, FACED_PX = 20.0, 2.0, 0.01
"""How much more a difference of hue costs, and one of brightness, where nothing was seen of a side
that faced a camera, and the squares of its shares at which it is half of that: speckle is hue, and
the pictures hardly tell of it there. A higher price of brightness is missed in recorded frames."""
CALM = 0.000125
"""Weight of the squares of the light's numbers, the constant one apart, against the mean squared
change of the factors that were seen."""
SHADE, SHADE_WEIGHT = 0.2, 0.02
"""What turns its back to a camera is lit like the darkest of what is seen, at this quantile, and
besides by lamps that it faces (`_beyond_shade`). The weight is against all that is seen."""
LEAST_SHARE = 0.12
"""Of the scene's brightness that a lamp's shadow takes, as every lamp starts: those that no shadow
tells of end below."""
LEAST_HEIGHT = 0.35
"""Sine of a lamp's height over the level, as what it gives the floor tells what it gives a wall."""
BESIDE = 0.5
"""Cosine between the ways to a lamp and to the camera from which on what the camera sees tells all
that it does; one across the view or behind counts in full."""
MOST_LIT = 2.0
"""Times as bright as the shade, at most."""
_BACK = -0.1
"""Cosine to the camera under which a surface turns its back."""
_FAST = 1e6
_LEAST_SHARE = 1e-6
"""Pixels; where nothing was seen a colour is taken as it is."""
_LEAST_OPACITY = 1e-6
"""Of a Gaussian that became transparent."""


@dataclass(frozen=True, eq=False)
class _View:
    """A training frame as the model draws it before the fill."""

    frame: Frame
    camera: Camera
    picture: Float[Tensor, "1 H W 3"]
    """Person and scene without the shadow, sRGB."""
    weight: Float[Tensor, " H"]
    """Sum of each Gaussian's shares of the pixels."""
    away: Bool[Tensor, " H"]
    """True where the surface turns its back."""
    lit: Float[Tensor, "H 3"]
    """Colours in the light."""


def filled(
    model: DiscModel, capture: TrainingCapture, strength: float, seen: Seen
) -> dict[str, Tensor]:
    """Parameters by their names in the model's state, as they follow for what was little seen.

    First the light: as it is where it was seen, and no brighter elsewhere than in the shade. Then
    what neighbours would say of each colour: the even transition between those that were well seen
    and facing (`harmonic`); the more was seen, the more its own colour counts instead. Then the
    colours closest to that with which the training frames look as before (`closest`): what shines
    through the front, or has a small share of its pixels, gives way, and what is well seen stays.
    What turns its back and is still far from what neighbours say, or floats off the body, becomes
    transparent as far as the frames bear it (`kept_opacity`), and colours are found once more, now
    with hues that follow the neighbours by what was seen of sides that faced a camera alone; the
    less that was, the more differing from them costs, in hue and in brightness.
    ``strength`` is what a difference to the neighbours costs, per training frame, against one of a
    whole pixel.
    """
    gaussians, rows = model.gaussians, model.gaussians.human
    if gaussians.human_count < 2 or not float(seen.squares.sum()) > 0:
        return {}
    with torch.no_grad():
        normals = model.surface.normals(gaussians.means[rows])
        bones = model.surface.weights(gaussians.means[rows])
    views = _views(model, capture, normals)
    # An hour's motion is large, and no colour changes it.
    new = copy.deepcopy(model, {id(part): part for part in (model.track, model.residual)})
    names = [f"gaussians.{gaussians.colour}", "gaussians.opacity_logits"]
    if new.shading is not None:
        _dim(new, views)
        names += ["shading.coefficients", "shading.intensities"]
    own = gaussians.get_parameter(gaussians.colour)[rows, :3].detach().sigmoid()
    rough = laplacian(gaussians.means[rows], normals, bones, mirror_plane(new.track.body))
    facing = (seen.directions * normals).sum(-1) / seen.weight.clamp_min(1e-9)
    faced = seen.squares * facing.clamp_min(0).square()
    even = harmonic(own, faced.masked_fill(seen.little(), 0), EVEN * rough)
    pictures = _Pictures.of(new, views, own)
    relit = pictures.relit(own)
    told = even.lerp(relit, seen.certainty()[:, None])
    share, behind = len(views) / len(capture.train_frames), facing < 0
    squares = share * seen.squares
    price = torch.full_like(squares, strength * len(views))
    colours = _closest(pictures, told, squares, behind, price, torch.zeros_like(price))
    wrong = (colours - even).norm(dim=-1) * behind
    off_m = off_the_body(gaussians.means[rows], normals, model.surface)
    pixels = share * seen.weight.mean() * areas(gaussians)
    kept = kept_opacity(pictures.sights(colours), prices(wrong, off_m, pixels))
    sure = faced / (faced + FACED_PX)
    told = _in_hues_of(told, even.lerp(relit, sure[:, None]))
    pictures, unsure = replace(pictures, kept=kept), price * (1 - sure)
    held, tinted = price + BRIGHT * unsure, (HUE - BRIGHT) * unsure
    colours = _closest(pictures, told, squares, behind, held, tinted)
    with torch.no_grad():
        new.gaussians.get_parameter(gaussians.colour)[rows, :3] = colours.logit()
        opacities = (gaussians.opacities()[rows] * kept).clamp_min(_LEAST_OPACITY)
        thinner = torch.where(kept < 1, opacities.logit(), gaussians.opacity_logits[rows])
        new.gaussians.opacity_logits[rows] = thinner
    state = new.state_dict()
    return {name: state[name].detach().clone() for name in names}


def _closest(
    pictures: "_Pictures",
    told: Float[Tensor, "H 3"],
    squares: Float[Tensor, " H"],
    behind: Bool[Tensor, " H"],
    held: Float[Tensor, " H"],
    tinted: Float[Tensor, " H"],
) -> Float[Tensor, "H 3"]:
    """Colours closest to those ``told`` with which the pictures look as before the fill.

    ``squares``: of the shares of all pictures' pixels. What was seen from ``behind`` alone must not
    glare; the front makes up for it. ``held``: what a squared difference to those told costs,
    ``tinted``: what one of hue costs besides.
    """
    diagonal = squares * pictures.brightness()
    colours = closest(told, pictures.missing(told), pictures.twice, diagonal, held, tinted, STEPS)
    most = (MOST_BEHIND * squares / (squares + BARELY_PX))[:, None]
    limited = told + (colours - told).clamp(-most, most)
    start = torch.where(behind[:, None], limited, colours).clamp(LEAST, MOST)
    held = held.masked_fill(behind, _FAST)
    missing = pictures.missing(start)
    colours = closest(start, missing, pictures.twice, diagonal, held, tinted, STEPS)
    return colours.clamp(LEAST, MOST)


def _in_hues_of(bright: Float[Tensor, "H 3"], hues: Float[Tensor, "H 3"]) -> Float[Tensor, "H 3"]:
    """Colours with the mean over the channels of the first, and the rest of the other."""
    return hues + (bright - hues).mean(-1, keepdim=True)


@torch.no_grad()
def _layers(model: DiscModel, frame: Frame, camera: Camera) -> Layers:
    return model.at([frame.mid_us], camera.center(), hard_semantics=True)


def _views(
    model: DiscModel, capture: TrainingCapture, normals: Float[Tensor, "H 3"]
) -> list[_View]:
    frames = capture.train_frames
    generator = torch.Generator().manual_seed(0)
    views = []
    for frame in frames[:: -(-len(frames) // MOST_FRAMES)]:
        camera = capture.camera(frame).to(model.device)
        layers = _layers(model, frame, camera)
        person, scene = layers.human.channels[..., :3], layers.scene.channels[..., :3]
        with torch.no_grad():
            picture = draw_values(layers, camera, person, scene)
        weight = shares_in(layers, camera, generator, draws=0)[:, 0]
        away = facing(layers, normals, camera) < _BACK
        views.append(_View(frame, camera, picture, weight, away, person[0].detach()))
    return views


@torch.no_grad()
def _dim(model: DiscModel, views: Sequence[_View]) -> None:
    """Ridge regression of the light to its own factors by what was seen of each, and to shade.

    Linear in the light's numbers (`Shading.terms`), all colours at once.
    """
    assert model.shading is not None
    terms, factors, lowest_m = [], [], 0.0
    for view in views:
        layers = _layers(model, view.frame, view.camera)
        lowest_m = min(lowest_m, _lowest_m(model, layers))
        found = model.light_terms(layers, view.frame.mid_us)
        terms.append(found[0][0].double())
        factors.append(found[1][0].double())
    weights = torch.cat([view.weight for view in views]).double()
    total, away = weights.sum(), [view.away for view in views]
    rows = SHADE_WEIGHT * total / torch.stack(away).sum().clamp_min(1)
    shade = _shade(torch.cat(factors), weights)
    width = terms[0].shape[1]
    ridge = torch.full((width,), CALM, dtype=weights.dtype, device=weights.device) * total
    ridge[0] = 0.0  # the same light from everywhere
    squares, told = ridge.diag(), weights.new_zeros(width, 3)
    for view, term, factor, back in zip(views, terms, factors, away, strict=True):
        weighed = term * view.weight.double()[:, None]
        eye = view.camera.center()
        brighter = _beyond_shade(model, term[back], -lowest_m, eye)[:, None]
        behind = rows * term[back]
        squares += weighed.T @ term + behind.T @ term[back]
        told += weighed.T @ (factor - 1) + behind.T @ (brighter * shade - 1)
    numbers = torch.linalg.solve(squares, told).to(model.shading.coefficients)
    bent = model.shading.coefficients.flatten(0, 1)
    model.shading.coefficients.copy_(numbers[: len(bent)].view_as(model.shading.coefficients))
    model.shading.intensities.copy_(numbers[len(bent) :])


def _lowest_m(model: DiscModel, layers: Layers) -> float:
    """How high the person's lowest parts are over the middle of where they go, metres."""
    if model.lamps is None:
        return 0.0
    heights = (layers.human.means[0] - model.lamps.center) @ model.lamps.up
    return float(heights.sort().values[len(heights) // 100])


def _beyond_shade(
    model: DiscModel, terms: Float[Tensor, "N K"], floor_m: float, eye: Float[Tensor, "3"]
) -> Float[Tensor, " N"]:
    """How much brighter than in the shade places are by the lamps that they face, 1 and up.

    A shadow on the floor tells what its lamp gives there against the light from all around, and so
    what it gives nearer by, to places that nobody saw as well. ``terms`` are those of
    `Shading.terms`, the lamps' the last; ``floor_m``: how far the floor lies below the person's
    middle; ``eye``: the camera's place, for what lamps on its side do, it sees.
    """
    light, shadow, lamps = model.surface_light(), model.shadow, model.lamps
    if light is None or light.lamps is None or shadow is None or lamps is None:
        return terms.new_ones(len(terms))
    shares = shadow.share_logits.sigmoid()
    lit = ((1 - shares).pow(-GAMMA) - 1) * (shares > LEAST_SHARE)
    away = lamps.distances()
    ways = (lamps.places() - lamps.center) / away[:, None]
    beside = normalize(eye - lamps.center, dim=0)
    lit = lit * (1 - ways @ beside / BESIDE).clamp(0, 1)
    height = (ways @ lamps.up).clamp_min(LEAST_HEIGHT)
    # from the lamp through the person's middle on to the floor, against to the middle
    farther = 1 + floor_m / (away * height)
    each = (lit * farther.square() / height).to(terms)
    return (1 + terms[:, -len(each) :] @ each).pow(1 / GAMMA).clamp(max=MOST_LIT)


def _shade(factors: Float[Tensor, "N 3"], weights: Float[Tensor, " N"]) -> Float[Tensor, "3"]:
    """The mean factor, as much darker as the quantile `SHADE` is of all brightnesses."""
    mean = (factors * weights[:, None]).sum(0) / weights.sum()
    bright, order = factors.mean(-1).sort()
    reached = weights[order].cumsum(0) >= SHADE * weights.sum()
    return mean * (bright[reached.int().argmax()] / mean.mean()).clamp(max=1)


@dataclass(frozen=True, eq=False)
class _Pictures:
    """The views as linear functions of the person's colours: ``J y + rest``."""

    views: Sequence[_View]
    layers: Sequence[Layers]
    light: Sequence[Float[Tensor, "1 H 3"]]
    """Factors on the colours."""
    kept: Float[Tensor, " H"] | None = None
    """Factors on the opacities."""

    @classmethod
    def of(cls, model: DiscModel, views: Sequence[_View], own: Float[Tensor, "H 3"]) -> "_Pictures":
        """``own``: the colours of ``model``, sRGB without light."""
        layers = [_layers(model, view.frame, view.camera) for view in views]
        return cls(views, layers, [each.human.channels[..., :3] / own for each in layers])

    def sights(self, colours: Float[Tensor, "H 3"]) -> list[Sight]:
        """The views as drawn with these colours, and as they shall look."""
        return [
            Sight(layers, view.camera, colours[None] * light, view.picture)
            for view, layers, light in zip(self.views, self.layers, self.light, strict=True)
        ]

    def brightness(self) -> Float[Tensor, " H"]:
        """Mean square of the factors."""
        return torch.stack([light[0].square().mean(-1) for light in self.light]).mean(0)

    @torch.no_grad()
    def relit(self, own: Float[Tensor, "H 3"]) -> Float[Tensor, "H 3"]:
        """Colours that in the new light are closest to what ``own`` were in the old, by shares."""
        above, below = _LEAST_SHARE * own, torch.full_like(own, _LEAST_SHARE)
        for view, light in zip(self.views, self.light, strict=True):
            above += view.weight[:, None] * light[0] * view.lit
            below += view.weight[:, None] * light[0].square()
        return above / below

    def missing(self, values: Float[Tensor, "H 3"]) -> Float[Tensor, "H 3"]:
        """``J^T (b - J y - rest)``, b being the pictures before the fill."""
        total = torch.zeros_like(values)
        for view, layers, light in zip(self.views, self.layers, self.light, strict=True):
            leaf = values.clone().requires_grad_()
            scene = layers.scene.channels[..., :3]
            picture = draw_values(layers, view.camera, leaf[None] * light, scene, self.kept)
            lacks = view.picture - picture.detach()
            total += transposed(picture, leaf, lacks)
        return total

    def twice(self, values: Float[Tensor, "H 3"]) -> Float[Tensor, "H 3"]:
        """``J^T J y``."""
        total = torch.zeros_like(values)
        for view, layers, light in zip(self.views, self.layers, self.light, strict=True):
            leaf = values.clone().requires_grad_()
            picture = draw_values(layers, view.camera, leaf[None] * light, kept=self.kept)
            total += transposed(picture, leaf, picture.detach())
        return total
