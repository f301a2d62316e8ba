"""What all methods of one model share: the person's settings, and the model at its start."""

from dataclasses import dataclass, field

import torch

from evsplat.body import BodyTrack, SurfaceSamples, load_body_track
from evsplat.capture import Policy, TrainingCapture
from evsplat.deform.human_scene import DeformConfig, HumanSceneModel, Semantics
from evsplat.deform.pose_spline import PoseSpline
from evsplat.errors import DataError
from evsplat.gaussians import BodyFrames, DensifyConfig, GaussianSet, Part
from evsplat.methods.composition import Composition, HeldOut
from evsplat.methods.config import OptimisationConfig, Weight
from evsplat.methods.prefit import fit_skinning
from evsplat.methods.rates import learning_of
from evsplat.methods.starts import HumanStartConfig
from evsplat.objectives import Isometry, Objective, SkinningPrior

SURFACE_SAMPLES = 100_000
"""Body surface points drawn once for the skinning prior."""


@dataclass(frozen=True)
class PersonLossConfig:
    """Weights of the terms that every method with this person has (3DGS-Avatar; A18)."""

    l1: Weight = 0.8
    dssim: Weight = 0.2
    """1 - SSIM of the whole frame, the better variant of A18; the base method has L1 alone."""
    perceptual_weight: Weight = 0.01
    skinning: Weight = ((0, 10.0), (1_000, 0.1))
    isometry_centers: Weight = 1.0
    isometry_covariances: Weight = 100.0


@dataclass(frozen=True)
class PersonConfig:
    """Settings of the person."""

    policy: Policy = field(default_factory=Policy)
    """What training may see of what is held out."""
    human: HumanStartConfig = field(default_factory=HumanStartConfig)
    deform: DeformConfig = field(default_factory=DeformConfig)
    isometry_refresh: int = 100
    """Steps between neighbour searches."""
    isometry_samples: int = 1_024
    """Gaussians whose isometry is looked at per step."""
    skinning_points: int = 1_024
    """Surface points per step of the skinning prior (1.6)."""
    skinning_prefit_steps: int = 2_000
    """Steps of fitting the skinning network alone before training proper. 2,000 bring its squared
    error against the body's weights to 0.03; with 400 it stays near 0.08 for good."""
    optimisation: OptimisationConfig = field(default_factory=OptimisationConfig)
    densify_human: DensifyConfig = field(default_factory=lambda: DensifyConfig(max_count=10_000))


@dataclass(frozen=True)
class Ground:
    """What a model is made from."""

    capture: TrainingCapture
    track: BodyTrack
    """On the CPU, where silhouettes are drawn."""
    surface: SurfaceSamples
    """Of the canonical body."""
    generator: torch.Generator
    """All randomness of the run."""

    @classmethod
    def of(cls, capture: TrainingCapture, seed: int, track: BodyTrack | None = None) -> "Ground":
        """Read the body, unless its ``track`` is given, and seed everything."""
        generator = torch.Generator().manual_seed(seed)
        torch.manual_seed(seed)
        track = track or load_body_track(capture)
        if not capture.train_frames:
            raise DataError(f"{capture.path}: no frame has split 'train'; nothing to learn from.")
        return cls(capture, track, track.body.sample_surface(SURFACE_SAMPLES, generator), generator)

    @property
    def times_us(self) -> list[int]:
        """Mid-exposures of the training frames."""
        return [frame.mid_us for frame in self.capture.train_frames]


@dataclass(frozen=True)
class Build:
    """A model at its start, and what objectives are made from."""

    ground: Ground
    model: HumanSceneModel
    prior: SkinningPrior

    @classmethod
    def of(
        cls,
        config: PersonConfig,
        ground: Ground,
        gaussians: GaussianSet,
        semantics: Semantics,
        *,
        device: torch.device | str,
        fit: bool,
        pose_spline: PoseSpline | None = None,
    ) -> "Build":
        """Make the networks and, with ``fit``, bring skinning to the body's weights."""
        model = HumanSceneModel(
            config.deform, semantics, ground.track, ground.times_us, gaussians, pose_spline
        ).to(device)
        prior = SkinningPrior(ground.surface.to(device), config.skinning_points)
        if fit and model.skinning is not None:
            fit_skinning(model, prior, config.skinning_prefit_steps, ground.generator)
        return cls(ground, model, prior)

    def body_frames(self) -> BodyFrames:
        """The body as given at the training frames."""
        track = self.model.track
        return BodyFrames(track.body, track.bones(self.ground.times_us))

    def composition(
        self,
        config: PersonConfig,
        loss: PersonLossConfig,
        observed: list[Objective],
        *,
        weights: dict[str, Weight],
        densify: dict[Part, DensifyConfig],
        capture: TrainingCapture | None = None,
        held_out: HeldOut | None = None,
    ) -> Composition:
        """Everything together.

        ``observed`` are the objectives that compare with recorded data; ``weights`` and ``densify``
        are those that the method has beyond the person's; ``capture`` is the recording where the
        method does not see all of it; ``held_out`` is what frames beside the training frames teach.
        """
        objectives = list(observed)
        if self.model.skinning is not None:
            objectives.append(self.prior)
        if loss.isometry_centers != 0.0 or loss.isometry_covariances != 0.0:
            isometry = Isometry(refresh=config.isometry_refresh, samples=config.isometry_samples)
            objectives.append(isometry)
        return Composition(
            model=self.model,
            objectives=objectives,
            weights={
                "l1": loss.l1,
                "dssim": loss.dssim,
                "skinning": loss.skinning,
                "isometry_centers": loss.isometry_centers,
                "isometry_covariances": loss.isometry_covariances,
                **weights,
            },
            learning=learning_of(self.model, config.optimisation),
            densify={"human": config.densify_human, **densify},
            body_frames=None if self.model.semantics == "fixed" else self.body_frames(),
            generator=self.ground.generator,
            capture=capture,
            held_out=held_out,
        )
