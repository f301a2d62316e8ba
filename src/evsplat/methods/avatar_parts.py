"""Parts of 3DGS-Avatar that `paper`, `avatar3dgs` and `avatar3dgs_semantic` share.

Numbers of the form 1.5 are sections of the reference that docs/baselines.md quotes.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import torch

from evsplat.body import BodyTrack, SurfaceSamples
from evsplat.capture import Frame, TrainingCapture
from evsplat.gaussians import GaussianSet
from evsplat.methods.base import Purpose
from evsplat.methods.learning import Learning, Network, Rate, parameters_of, row_rates
from evsplat.methods.prefit import fit_skinning
from evsplat.methods.settings import Nominal, NotNegative, Weight
from evsplat.models.paper import PaperModel, Semantics
from evsplat.objectives import Isometry, Objective, Photometric, SkinningPrior
from evsplat.objectives.perceptual import PerceptualChoice, choose_perceptual
from evsplat.pictures.box import Box
from evsplat.ranges import Above, AtLeast, AtMost, ReadIf, Within

SURFACE_SAMPLES = 100_000
"""Body surface points drawn once for the skinning prior."""
SKINNING_POINTS = 1_024
"""Surface points per step of the skinning prior."""
ISOMETRY_REFRESH = 100
"""Steps between neighbour searches."""
CLIP = 0.1
"""Largest gradient norm of all networks together."""
LATENT_WEIGHT_DECAY = 0.05
HUMAN_START = 1_000.0
"""Nominal iteration until which the person's Gaussians are frozen while skinning settles."""

_POSES = ReadIf("networks.pose_start", "a number", lambda start: start is not None)
_PERCEPTUAL = ReadIf("terms.perceptual", "not none", lambda name: name != "none")


@dataclass(frozen=True)
class Networks:
    """Networks that move and colour the person."""

    width: Annotated[int, AtLeast(1)] = 128
    """Hidden width of the non-rigid and the skinning network."""
    colour_width: Annotated[int, AtLeast(1)] = 64
    """Hidden width of the colour networks (A10)."""
    non_rigid_start: Nominal = 3_000
    """Nominal iteration at which the non-rigid network is switched on (A9)."""
    pose_noise: NotNegative = 0.1
    """Standard deviation of the noise on the rotation matrices fed to the pose encoder, in half of
    the steps."""
    pose_start: Nominal | None = None
    """Nominal iteration from which pose residuals are learned; null = never. 3DGS-Avatar starts at
    5000 (A9). Exact poses get worse by it, noisy ones better."""


@dataclass(frozen=True)
class AvatarTerms:
    """Terms of the loss beside the picture's."""

    perceptual: PerceptualChoice = "none"
    """``lpips_vgg`` is the paper's and needs its weights (see `evsplat doctor`); ``st_lpips`` runs
    with the extra `perceptual`; ``available`` takes the first of them that runs. The term has the
    name of what it is."""
    perceptual_weight: Annotated[Weight, _PERCEPTUAL] = 0.01
    """Weight of the perceptual distance."""
    skinning: Weight = ((0, 10.0), (1_000, 0.1))
    """Weight of the squared error of the skinning network on the body's surface."""
    skinning_prefit_steps: Annotated[int, AtLeast(0)] = 2_000
    """Steps of fitting the skinning network alone before training proper. 2,000 bring its squared
    error against the body's weights to 0.03; with 400 it stays near 0.08 for good."""
    isometry_centers: Weight = 1.0
    """Weight of neighbours' change of distance when posed."""
    isometry_covariances: Weight = 100.0
    """Weight of neighbours' change of covariance when posed."""
    isometry_samples: Annotated[int, AtLeast(1)] = 1_024
    """Gaussians whose isometry is looked at per step."""


@dataclass(frozen=True)
class AvatarRates:
    """Adam's learning rates at the start of training."""

    means: NotNegative = 5.5e-4
    """Centres, metres (1.6e-4 times 3DGS-Avatar's extent of 3.47)."""
    scales_log: NotNegative = 5e-3
    """Logarithms of the standard deviations."""
    opacity_logits: NotNegative = 0.05
    """Opacities before the sigmoid."""
    features: NotNegative = 5e-3
    """Colour features; 3DGS-Avatar: 1e-3 over all 15,000 steps."""
    skinning: NotNegative = 1e-4
    """Skinning network."""
    non_rigid: NotNegative = 1e-3
    """Non-rigid network and pose encoder."""
    colour: NotNegative = 1e-3
    """Both colour networks."""
    latents: NotNegative = 1e-3
    """Latents of frames."""
    pose: Annotated[float, AtLeast(0), _POSES] = 1e-4
    """Pose residuals, radians and metres."""
    final: Annotated[float, Above(0), AtMost(1)] = 0.1
    """Factor that rates of centres and networks reach at the end, exponentially."""
    gaussians_final: Annotated[float, Above(0), AtMost(1)] = 0.1
    """The same for the Gaussians' other attributes; 3DGS-Avatar keeps their rates, 1."""
    constant: Annotated[float, Within(0, 0.99)] = 0.3
    """Share of the training before the decay begins; 3DGS-Avatar: none, over 15,000 steps."""


RELEASED_RATES = AvatarRates(features=1e-3, constant=0.0, gaussians_final=1.0)
"""Rates of the released 3DGS-Avatar."""


def avatar(
    capture: TrainingCapture,
    track: BodyTrack,
    gaussians: GaussianSet,
    surface: SurfaceSamples,
    generator: torch.Generator,
    box_of: Callable[[Frame], Box | None],
    *,
    semantics: Semantics,
    released: bool,
    scene_direction_dropout: float,
    networks: Networks,
    terms: AvatarTerms,
    l1: Weight,
    dssim: Weight,
    device: torch.device | str,
    purpose: Purpose,
) -> tuple[PaperModel, list[Objective], dict[str, Weight]]:
    """The model at its start, its skinning brought to the body's weights; losses and their weights.

    The first of the losses compares pictures, perceptual distance in boxes; the others are priors.
    """
    # Weights of a perceptual network need not be there to draw; where they are missed otherwise,
    # that is said before the fit below.
    choice = "none" if purpose == "draw" else terms.perceptual
    name, perceptual = choose_perceptual(choice, device=device)
    model = PaperModel(
        track,
        [frame.mid_us for frame in capture.train_frames],
        gaussians,
        semantics=semantics,
        scene_direction_dropout=scene_direction_dropout,
        released=released,
        **vars(networks),
    ).to(device)
    prior = SkinningPrior(surface.to(device), SKINNING_POINTS)
    if purpose == "train":
        fit_skinning(model, prior, terms.skinning_prefit_steps, generator)
    pictures = Photometric(
        capture, box_of, dssim=dssim != 0.0, perceptual=perceptual, perceptual_term=name
    )
    objectives: list[Objective] = [pictures, prior]
    if terms.isometry_centers != 0.0 or terms.isometry_covariances != 0.0:
        objectives.append(Isometry(refresh=ISOMETRY_REFRESH, samples=terms.isometry_samples))
    weights = {
        "l1": l1,
        "dssim": dssim,
        "skinning": terms.skinning,
        "isometry_centers": terms.isometry_centers,
        "isometry_covariances": terms.isometry_covariances,
    }
    if perceptual is not None:
        weights[name] = terms.perceptual_weight
    return model, objectives, weights


def learning_of(model: PaperModel, rates: AvatarRates) -> Learning:
    """Groups of the paper's model."""
    rows = row_rates(
        {
            "scales_log": rates.scales_log,
            "quaternions": 1e-3,
            "opacity_logits": rates.opacity_logits,
            "features": rates.features,
        },
        means=rates.means,
        final=rates.gaussians_final,
        means_final=rates.final,
        constant=rates.constant,
    )
    parts = (
        (parameters_of(model.skinning), rates.skinning, 0.0),
        (parameters_of(model.deformation), rates.non_rigid, 0.0),
        (parameters_of(model.human_colour, model.scene_colour), rates.colour, 0.0),
        (parameters_of(model.latents), rates.latents, LATENT_WEIGHT_DECAY),
        (parameters_of(model.residual), rates.pose, 0.0),
    )
    networks = [
        Network(parameters, Rate(rate, rates.final, rates.constant), decay, clipped=True)
        for parameters, rate, decay in parts
    ]
    return Learning({"gaussians": rows}, networks, CLIP, HUMAN_START)
