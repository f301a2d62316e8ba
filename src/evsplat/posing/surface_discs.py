"""A body as flat discs on its surface, drawn in one colour each under a smooth light."""

from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from evsplat.body import Body
from evsplat.body.body import skin_with_linear
from evsplat.body.surface import SurfaceSamples, vertex_normals
from evsplat.camera import Camera
from evsplat.compiled import native, runs_native
from evsplat.neighbours import far_apart
from evsplat.render import RenderOutput, Splats, render

_OVERSAMPLED = 5
"""Surface points drawn per disc; the discs lie at those farthest from each other."""
_WIDTH = 0.5
"""Standard deviation of a disc over the side of the square that is its share of the surface."""
_FLATNESS = 0.1
_OPACITY = 0.95
_OFFSET_M = 0.01
"""How far clothes and hair typically lie from the bare body."""
_LAYER_M, _LAYER_REACH_M = 0.015, 0.05
"""Thickness of clothes, hair and shoes that neighbours share, and how far it is about the same."""
_ANCHORS = 300
_SIZE = 0.015
"""Share by which clothes, hair and shoes make a person look larger or smaller as a whole. Such a
person is drawn nearer or farther off, so that its motion keeps the distance that it had."""
_NEIGHBOURS, _SMOOTH_M = 40, 0.05
"""Discs that a vertex moves with, and how near they are, metres."""
_INSET = 0.3
"""What is left to learn of how far discs must be set back, in units of `_OFFSET_M`."""
_BEYOND = 0.3, 0.55
"""How far discs reach beyond an outline, in their widths and in pixels: with it the body that ships
covers as much of pictures of 128 to 384 pixels as its mesh does, to 4 %."""
_LOW_PASS = 0.1
"""Variance of the low-pass, px^2: about that of a square pixel."""


class SurfaceDiscs(nn.Module):
    """N discs of the canonical body, with what is learned of the person's look.

    Each has a colour and an offset along its normal, and each bone one in any direction, for
    clothes, hair, and hands that are held in another way; all share a light: shares that the
    spherical harmonics of the normal in the world add to the colours.
    """

    near: Tensor
    quaternions: Tensor
    scales: Tensor

    def __init__(self, body: Body, count: int, generator: torch.Generator) -> None:
        """Discs spread evenly over the surface, grey."""
        super().__init__()
        self.body = body
        drawn = body.sample_surface(_OVERSAMPLED * count, generator)
        rows = far_apart(drawn.points, count)
        self.samples = SurfaceSamples(drawn.points[rows], drawn.normals[rows], drawn.weights[rows])
        a, b, c = body.canonical_vertices()[body.faces].unbind(1)
        area = float(torch.linalg.cross(b - a, c - a).norm(dim=-1).sum()) / 2
        width = _WIDTH * (area / count) ** 0.5
        scales = torch.tensor([width, width, _FLATNESS * width]).repeat(count, 1)
        self.register_buffer("quaternions", _turned_to(self.samples.normals))
        self.register_buffer("scales", scales)
        self.colours = nn.Parameter(torch.full((count, 3), 0.5))
        self.inset = nn.Parameter(torch.tensor(0.0))
        self.offsets = nn.Parameter(torch.zeros(count))
        self.register_buffer("near", _nearness(self.samples.points))
        self.layer = nn.Parameter(torch.zeros(self.near.shape[1]))
        self.bone_offsets = nn.Parameter(torch.zeros(len(body.parents), 3))
        self.light = nn.Parameter(torch.zeros(8))
        self.nearer = nn.Parameter(torch.tensor(0.0))

    def splats(
        self,
        rotations: Float[Tensor, "T J 3 3"],
        transl: Float[Tensor, "T 3"],
        count: int | None = None,
        pixel_m: float = 0.0,
    ) -> Splats:
        """The discs in a pose per time; with ``count`` that many, as much wider.

        They are set back by as much as they reach beyond an outline, by their width and by the
        low-pass of pixels of ``pixel_m``.
        """
        n = len(self.samples.points) if count is None else min(count, len(self.samples.points))
        normals, weights = self.samples.normals[:n], self.samples.weights[:n]
        wider = (len(self.samples.points) / n) ** 0.5
        sizes = self.scales[:n] * wider
        reach = (_BEYOND[0] * sizes[0, 0] + _BEYOND[1] * pixel_m) / _OFFSET_M
        layer = _LAYER_M / _OFFSET_M * (self.near[:n] @ self.layer)
        offsets = normals * (self.inset + self.offsets[:n] + layer - reach)[:, None]
        offsets = offsets + weights @ self.bone_offsets
        points = self.samples.points[:n] + _OFFSET_M * offsets
        bones = self.body.canonical_to_world(rotations, transl)
        means, _, linear = skin_with_linear(points, weights, bones)
        shade = shade_normals(linear, normals, self.light)
        opacities = torch.full((len(points),), _OPACITY)
        colours = self.colours[:n] * shade[..., None]
        return Splats(means, self.quaternions[:n], sizes, opacities, colours, linear=linear)

    def draw(
        self,
        rotations: Float[Tensor, "T J 3 3"],
        transl: Float[Tensor, "T 3"],
        camera: Camera,
        behind: Float[Tensor, "T H W 3"],
        count: int | None = None,
    ) -> Float[Tensor, "T H W 3"]:
        """Pictures of the discs before the scene; ``count`` as in `splats`."""
        drawn = self.drawn(rotations, transl, camera, count)
        return drawn.image + (1 - drawn.alpha[..., None]) * behind

    def drawn(
        self,
        rotations: Float[Tensor, "T J 3 3"],
        transl: Float[Tensor, "T 3"],
        camera: Camera,
        count: int | None = None,
    ) -> RenderOutput:
        """Pictures of the discs alone; ``count`` as in `splats`."""
        moved = transl - self.nearer * self.nearer_m(transl, camera)
        depth = camera.project(transl.detach() + self.body.rest_joints[0])[1]
        pixel_m = float(depth.clamp_min(0.1).mean() / camera.K[0, 0])
        splats = self.splats(rotations, moved, count, pixel_m)
        return render(splats, camera, low_pass=_LOW_PASS)

    def colour_from(
        self,
        rotations: Float[Tensor, "T J 3 3"],
        transl: Float[Tensor, "T 3"],
        camera: Camera,
        images: Float[Tensor, "T H W 3"],
        *,
        first: int = 0,
        count: int | None = None,
    ) -> None:
        """Set each colour to the mean of the pixels that show the disc, by how much they do.

        Those before ``first`` stay; ``count`` as in `splats`.
        """
        with torch.enable_grad():
            drawn = self.drawn(rotations, transl, camera, count).image
            shares = [
                torch.autograd.grad((drawn * of).sum(), self.colours, retain_graph=True)[0]
                for of in (images, torch.ones_like(images))
            ]
        shown, total = shares
        with torch.no_grad():
            mean = shown.sum(0) / total.sum(0).clamp_min(1e-6)
            self.colours[first:] = ((shown + 0.1 * mean) / (total + 0.1))[first:]

    def nearer_m(self, transl: Float[Tensor, "T 3"], camera: Camera) -> Float[Tensor, "T 3"]:
        """Vectors along the view, as long as looks of a typical size hide of a distance, metres."""
        return _SIZE * (transl + self.body.rest_joints[0] - camera.center())

    @torch.no_grad()
    def dressed(self) -> Body:
        """The body with its surface where the discs are: with clothes, hair and shoes.

        Joints, weights and triangles stay. A vertex moves as the discs near it do.
        """
        body = self.body
        vertices = body.canonical_vertices()
        normals = vertex_normals(vertices, body.faces)
        thick = self.inset + self.offsets + _LAYER_M / _OFFSET_M * (self.near @ self.layer)
        found = cKDTree(self.samples.points.numpy()).query(vertices.numpy(), _NEIGHBOURS)
        apart, rows = torch.from_numpy(found[0]).float(), torch.from_numpy(found[1])
        near = torch.exp(-0.5 * (apart / _SMOOTH_M).square()) + 1e-6
        thick = (near * thick[rows]).sum(1) / near.sum(1)
        moved = _OFFSET_M * (thick[:, None] * normals + body.weights @ self.bone_offsets)
        spread = (body.weights @ body.canonical_bone_transforms().flatten(1)).unflatten(1, (4, 4))
        back = torch.linalg.solve(spread[:, :3, :3], moved[..., None])[..., 0]
        return replace(body, rest_vertices=body.rest_vertices + back)

    def price(self) -> Float[Tensor, ""]:
        """What offsets and light cost, as minus the logarithm of a prior."""
        offsets = self.offsets.square().sum() + self.bone_offsets.square().sum()
        offsets = offsets + self.layer.square().sum() + (self.inset / _INSET).square()
        offsets = offsets + self.nearer.square()
        return 0.5 * offsets + 2 * self.light.square().sum()


def shade_normals(
    linear: Float[Tensor, "T N 3 3"], normals: Float[Tensor, "N 3"], light: Float[Tensor, "8"]
) -> Float[Tensor, "T N"]:
    """Brightness of turned unit normals: 1 and the harmonics of `_harmonics` by their ``light``."""
    if all(map(runs_native, (linear, normals, light))):
        shade: Tensor = _NativeShade.apply(linear, normals, light)
        return shade
    turned = (linear @ normals[:, :, None]).squeeze(-1)
    return 1 + _harmonics(nn.functional.normalize(turned, dim=-1)) @ light


class _NativeShade(torch.autograd.Function):
    """`shade_normals` in the compiled module, for normals that nobody learns."""

    @staticmethod
    def forward(ctx: Any, linear: Tensor, normals: Tensor, light: Tensor) -> Tensor:
        given = [tensor.detach().contiguous() for tensor in (linear, normals, light)]
        shade = linear.new_empty(linear.shape[:2])
        native.shade_normals(*given, shade)
        ctx.save_for_backward(*given)
        return shade

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        linear, normals, light = ctx.saved_tensors
        by_linear = torch.empty_like(linear) if ctx.needs_input_grad[0] else None
        by_light = torch.empty_like(light)
        above = upstream[0].contiguous()
        native.shade_normals_backward(linear, normals, light, above, by_linear, by_light)
        return by_linear, None, by_light


def _harmonics(normals: Float[Tensor, "*T N 3"]) -> Float[Tensor, "*T N 8"]:
    """Spherical harmonics of first and second order, up to factors."""
    x, y, z = normals.unbind(-1)
    return torch.stack([x, y, z, x * y, y * z, x * z, x * x - y * y, 3 * z * z - 1], -1)


def _nearness(points: Float[Tensor, "N 3"]) -> Float[Tensor, "N A"]:
    """Shares of A of the points, spread out, in each: rows of unit length."""
    apart = torch.cdist(points, points[:_ANCHORS])
    near = torch.exp(-0.5 * (apart / _LAYER_REACH_M).square())
    return torch.nn.functional.normalize(near, dim=1)


def _turned_to(normals: Float[Tensor, "N 3"]) -> Float[Tensor, "N 4"]:
    """The shortest rotations of z to each normal, wxyz."""
    x, y, z = normals.unbind(-1)
    half = torch.stack([1 + z, -y, x, torch.zeros_like(z)], -1)
    # Straight down there is no shortest one; half a turn about x serves.
    half_turn = torch.tensor([0.0, 1.0, 0.0, 0.0])
    return torch.where((1 + z < 1e-4)[:, None], half_turn, half)
