"""Even samples on a triangle mesh with everything that skinning needs at each of them."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True)
class SurfaceSamples:
    """Points on a body's surface."""

    points: Float[Tensor, "N 3"]
    normals: Float[Tensor, "N 3"]
    """Unit length, interpolated from the vertices."""
    weights: Float[Tensor, "N J"]
    """Skinning weights, interpolated from the vertices; rows sum to one."""

    def to(self, device: torch.device | str) -> "SurfaceSamples":
        """The same samples on ``device``."""
        return SurfaceSamples(
            self.points.to(device), self.normals.to(device), self.weights.to(device)
        )


def vertex_normals(
    vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]
) -> Float[Tensor, "V 3"]:
    """Unit normals: the mean of the adjacent faces' normals, weighted by area."""
    a, b, c = vertices[faces].unbind(1)
    twice_area = torch.linalg.cross(b - a, c - a)
    total = torch.zeros_like(vertices)
    for corner in range(3):
        total.index_add_(0, faces[:, corner], twice_area)
    return torch.nn.functional.normalize(total, dim=-1)


def sample_mesh(
    vertices: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    weights: Float[Tensor, "V J"],
    count: int,
    generator: torch.Generator,
) -> SurfaceSamples:
    """Draw ``count`` independent points, uniform by area; the generator is on the mesh's device."""
    a, b, c = vertices[faces].unbind(1)
    area = torch.linalg.cross(b - a, c - a).norm(dim=-1)
    # Inverse of the cumulative area in float64: no limit on faces, no bias of float32 sums.
    cumulative = area.double().cumsum(0)
    device = vertices.device
    draw = torch.rand(count, generator=generator, dtype=torch.float64, device=device)
    face = torch.searchsorted(cumulative, draw * cumulative[-1]).clamp_max(len(faces) - 1)
    u, v = torch.rand(2, count, generator=generator, dtype=vertices.dtype, device=device)
    root = u.sqrt()
    shares = torch.stack((1 - root, root * (1 - v), root * v), -1)[:, :, None]
    corners = faces[face]

    def interpolate(values: Float[Tensor, "V D"]) -> Float[Tensor, "N D"]:
        return (values[corners] * shares).sum(1)

    normals = torch.nn.functional.normalize(interpolate(vertex_normals(vertices, faces)), dim=-1)
    blended = interpolate(weights)
    return SurfaceSamples(interpolate(vertices), normals, blended / blended.sum(-1, keepdim=True))
