"""Surface samples: even by area, on the surface, with interpolated weights and normals."""

import numpy as np
import pytest
import torch
from scipy.stats import chisquare

from evsplat.body import default_body
from evsplat.body.surface import sample_mesh, vertex_normals


def icosphere_like(rows=12, columns=24):
    """A unit sphere of quads of very unequal area, split in triangles."""
    theta, phi = np.meshgrid(
        np.linspace(0, np.pi, rows + 1), np.linspace(0, 2 * np.pi, columns + 1), indexing="ij"
    )
    vertices = np.stack(
        (np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)), -1
    )
    index = np.arange(vertices[..., 0].size).reshape(vertices.shape[:2])
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    faces = np.concatenate((np.stack((a, b, c), -1), np.stack((a, c, d), -1))).reshape(-1, 3)
    return torch.tensor(vertices.reshape(-1, 3)), torch.tensor(faces)


@pytest.mark.parametrize("seed", range(3))
def test_samples_are_even_by_area_between_and_within_triangles(seed):
    vertices, faces = icosphere_like()
    weights = torch.ones(len(vertices), 1, dtype=vertices.dtype)
    count = 40_000
    samples = sample_mesh(
        vertices, faces, weights, count, torch.Generator().manual_seed(seed)
    ).points
    # A sphere's area is uniform in z and in longitude (Archimedes).
    unit = torch.nn.functional.normalize(samples, dim=-1)
    for values, low, high in (
        (unit[:, 2], -0.9, 0.9),  # off the poles, where the flat triangles cut the sphere
        (torch.atan2(unit[:, 1], unit[:, 0]), -np.pi, np.pi),
    ):
        inside = values[(values > low) & (values < high)]
        counts = torch.histc(inside, bins=12, min=low, max=high)
        # Facets leave ripples of about 1 %, below what this many samples resolve at p = 1e-6.
        assert chisquare(counts.numpy()).pvalue > 1e-6


def test_corners_are_not_favoured():
    triangle = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    samples = sample_mesh(
        triangle, torch.tensor([[0, 1, 2]]), torch.eye(3), 20_000, torch.Generator().manual_seed(0)
    )
    # Barycentric coordinates are the weights here: mean 1/3, variance 1/18 each.
    assert torch.allclose(samples.weights.mean(0), torch.full((3,), 1 / 3), atol=6e-3)
    assert torch.allclose(samples.weights.var(0), torch.full((3,), 1 / 18), atol=2e-3)
    assert torch.allclose(samples.points[:, 0], samples.weights[:, 1], atol=1e-6)
    assert torch.allclose(samples.normals, torch.tensor([0.0, 0, 1]).expand(20_000, 3))


def test_body_samples_have_weights_that_sum_to_one_and_follow_the_seed():
    body = default_body()
    first = body.sample_surface(2_000, torch.Generator().manual_seed(3))
    again = body.sample_surface(2_000, torch.Generator().manual_seed(3))
    other = body.sample_surface(2_000, torch.Generator().manual_seed(4))
    assert torch.equal(first.points, again.points) and not torch.equal(first.points, other.points)
    assert (first.weights.sum(-1) - 1).abs().max() < 1e-6 and (first.weights >= 0).all()
    # On the surface: a sample is never farther from the nearest vertex than the longest edge.
    vertices = body.canonical_vertices()
    corners = vertices[body.faces]
    longest = (corners - corners.roll(1, 1)).norm(dim=-1).max()
    assert torch.cdist(first.points[:500], vertices).amin(1).max() <= longest


def test_normals_of_a_sphere_point_outwards():
    vertices, faces = icosphere_like(40, 80)
    normals = vertex_normals(vertices, faces)
    inner = vertices[:, 2].abs() < 0.95
    seam = vertices[:, 0] > 0.99  # the two sides of the seam each miss half of their triangles
    cosine = (normals * vertices).sum(-1)
    assert cosine[inner & ~seam].min() > 0.99
