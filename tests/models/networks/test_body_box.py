"""Places on a body as networks are told of them."""

import torch

from evsplat.body import bounding_box
from evsplat.models.networks.body_box import BodyBox


def test_the_enlarged_box_goes_from_minus_one_to_one_and_encodings_see_zero_to_one(body):
    box, (low, high) = BodyBox(body), bounding_box(body)
    vertices = body.canonical_vertices()
    assert torch.equal(vertices.amin(0) > low, torch.ones(3, dtype=torch.bool))
    places = torch.stack([low, high, (low + high) / 2, low + (high - low) * torch.eye(3)[1]])
    expected = torch.tensor([[-1.0, -1, -1], [1, 1, 1], [0, 0, 0], [-1, 1, -1]])
    torch.testing.assert_close(box.normalise(places), expected, atol=1e-6, rtol=0)
    told = box.encoded(places, lambda shares: 7 * shares)
    torch.testing.assert_close(told, 3.5 * (expected + 1), atol=1e-5, rtol=0)
