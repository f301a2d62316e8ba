"""Colours of the person to start from: what the training frames show where each Gaussian is.

A colour that starts grey takes Adam hundreds of steps to become what any frame could have told, and
until then shape, poses and light are learned against a grey person.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from evsplat.capture import TrainingCapture
from evsplat.gaussians.surface_graph import harmonic, laplacian, mirror_plane
from evsplat.models.discs.model import DiscModel
from evsplat.models.seen import draw_values, facing, transposed

MOST_FRAMES = 24
"""Training frames that are looked at, spread evenly: drawing them takes the time."""
EVEN = 0.1
"""Strength of a link between neighbours, against the shares of the pixels that were seen, px."""
LEAST, MOST = 0.5 / 255, 1 - 0.5 / 255
"""Range of the colours, whose logits are kept."""


def first_colours(model: DiscModel, capture: TrainingCapture) -> Float[Tensor, "H 3"]:
    """Logits of the person's colours before training, as the training frames are coded.

    A Gaussian's colour is the mean of the blurry pictures by its shares of their pixels
    (transmittance x alpha, the gradient of a picture by a colour), the more the straighter its
    surface looks at the camera. What was little seen or not follows from its neighbours along the
    surface and from the other side (`harmonic`).
    """
    gaussians, rows = model.gaussians, model.gaussians.human
    with torch.no_grad():
        means = gaussians.means[rows]
        normals, bones = model.surface.normals(means), model.surface.weights(means)
    sums = means.new_zeros(len(means), 4)
    frames = capture.train_frames
    for frame in frames[:: -(-len(frames) // MOST_FRAMES)]:
        camera = capture.camera(frame).to(model.device)
        with torch.no_grad():
            layers = model.at([frame.mid_us], camera.center(), hard_semantics=True)
        channels = means.new_zeros(1, *sums.shape).requires_grad_()
        drawn = draw_values(layers, camera, channels)
        picture = capture.image(frame).to(drawn)
        shown = torch.cat([picture, torch.ones_like(picture[..., :1])], dim=-1)
        shares = transposed(drawn, channels, shown)[0]
        sums += shares * facing(layers, normals, camera).clamp_min(0)[:, None]
    weight = sums[:, 3]
    own = sums[:, :3] / weight[:, None].clamp_min(torch.finfo(weight.dtype).tiny)
    rough = laplacian(means, normals, bones, mirror_plane(model.track.body))
    return harmonic(own, weight, EVEN * rough).clamp(LEAST, MOST).logit()
