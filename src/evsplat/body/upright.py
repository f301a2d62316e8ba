"""Which way is up, from how a body stands."""

import torch
from jaxtyping import Float
from torch import Tensor

from evsplat.body.body import Body
from evsplat.body.canonical import find_legs
from evsplat.body.track import BodyTrack


def up_axis(track: BodyTrack) -> Float[Tensor, "3"]:
    """The signed world axis nearest to the body's own up direction in the middle of the track."""
    body = track.body
    legs = find_legs(body.parents.tolist(), body.joint_names)
    rest = body.canonical_vertices()
    if legs is None:
        tallest = int((rest.amax(0) - rest.amin(0)).argmax())
        below = rest[:, tallest] < rest[:, tallest].mean()
    else:
        below = _leg_share(body, (legs.left, legs.right)) > 0.5
    posed = track.vertices(int(track.times_us[len(track.times_us) // 2]))
    direction = posed[~below].mean(0) - posed[below].mean(0)
    up = torch.zeros(3)
    axis = int(direction.abs().argmax())
    up[axis] = direction[axis].sign()
    return up


def _leg_share(body: Body, thighs: tuple[int, int]) -> Tensor:
    """How much of each vertex's weight belongs to the joints from the thighs down."""
    chain = set(thighs)
    for joint, parent in enumerate(body.parents.tolist()):
        if parent in chain:
            chain.add(joint)
    return body.weights[:, sorted(chain)].sum(-1)
