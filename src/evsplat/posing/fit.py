"""Body poses from landmarks: a motion with the standard deviations of what it errs by."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from evsplat.body import BodyTrack
from evsplat.body.pose_errors import PoseErrors
from evsplat.body.rotations import six_to_matrix
from evsplat.camera import Camera
from evsplat.errors import DataError
from evsplat.landmarks import Landmarks
from evsplat.posing.evidence import Evidence
from evsplat.posing.flips import Doubt, settle_flips
from evsplat.posing.kinematics import (
    PLACE,
    SIX,
    TURNS,
    Points,
    left_jacobian,
    pose,
    row_slice,
    six_rates,
)
from evsplat.posing.prior import PosePrior, pose_prior
from evsplat.posing.problem import FitSettings, Problem, State, descend
from evsplat.posing.rig import ROWS, Attachments, Rig, attach, default_rig
from evsplat.posing.splines import UniformSpline
from evsplat.posing.start import TRUNK, first_trunk
from evsplat.posing.views import Views

_SIZE_SHARE = 0.012
"""Standard deviation of the best landmarks, as a share of the person's height in the picture."""
_LEAST_WEIGHT = 0.1
"""Weight of landmarks that the detector does not see: its guess is better than none."""
_BLUNT = 4.0
_STEPS = 30, 60
_FOCALS = tuple(2 ** (step / 3) for step in range(-4, 5))
_FOCAL_STD = 0.4
"""Focal lengths that are tried, in usual ones, and how much they differ in logarithm: two lenses in
three see 37 to 73 degrees where the usual one sees 53."""
_FEWEST = 4
"""Pictures with landmarks that a fit needs."""


@dataclass(frozen=True, eq=False)
class PoseFit:
    """A fitted motion."""

    problem: Problem
    state: State
    price: float
    doubts: tuple[Doubt, ...]
    """Limbs that could as well point the other way in depth."""

    @property
    def rig(self) -> Rig:
        """What moves."""
        return self.problem.rig

    @property
    def betas(self) -> Float[np.ndarray, "B"]:
        """Shape coefficients of the body."""
        return self.state.betas.numpy()

    def joints(self, times_us: Sequence[int]) -> Float[Tensor, "T J 3"]:
        """Joints of the body in the world, metres."""
        return pose(self.rig, self._vectors(times_us), self.state.betas).joints

    def track(self, times_us: Sequence[int]) -> BodyTrack:
        """The motion with key poses, and their errors, at some ascending times."""
        vectors = self._vectors(times_us)
        rows = vectors[:, TURNS].unflatten(1, (-1, 3))
        poses = self.rig.poses(six_to_matrix(vectors[:, SIX]), rows)
        body = self.rig.body(self.betas)
        transl = vectors[:, PLACE].numpy() - body.rest_joints[0].double().numpy()
        return BodyTrack(
            body,
            np.asarray(times_us, np.int64),
            poses,
            transl,
            source="fitted poses",
            errors=self.errors(times_us),
        )

    def errors(self, times_us: Sequence[int]) -> PoseErrors:
        """What the poses at some times err by, as far as the landmarks' errors are independent.

        The inverse of the Gauss-Newton matrix at the minimum (Laplace's approximation), for as many
        independent pictures as `FitSettings.independent_s` fits into the motion.
        """
        problem = self.problem
        weights = problem.spline.weights(_seconds(times_us))
        _, normal = problem.linearised(self.state)
        covariance = normal.factor(1e-9).covariance(weights) / problem.independent_pictures
        vectors = weights.of(self.state.control)
        joint_rad = np.zeros((len(vectors), len(self.rig.parents)))
        joint_rad[:, 0] = _spread(six_rates(vectors[:, SIX]), covariance[:, SIX, SIX])
        for joint, (row, share) in enumerate(
            zip(self.rig.row.tolist(), self.rig.share.tolist(), strict=True)
        ):
            if row >= 0:
                part = row_slice(ROWS[row])
                rate = left_jacobian(vectors[:, part] * share) * share
                joint_rad[:, joint] = _spread(rate, covariance[:, part, part])
        place = covariance[:, PLACE, PLACE].diagonal(dim1=-2, dim2=-1)
        return PoseErrors("estimated", joint_rad, place.clamp_min(0).sqrt().numpy())

    def _vectors(self, times_us: Sequence[int]) -> Tensor:
        return self.problem.spline.weights(_seconds(times_us)).of(self.state.control)


def fit_landmarks(
    landmarks: Landmarks,
    cameras: Sequence[Camera],
    span_us: tuple[int, int],
    *,
    rig: Rig | None = None,
    settings: FitSettings | None = None,
    prior: PosePrior | None = None,
    flips: bool = True,
) -> PoseFit:
    """Fit a body's motion over ``span_us`` to the landmarks of N pictures.

    ``cameras`` are those of the pictures. Without ``rig`` the body that ships is fitted, without
    ``prior`` the one that ships counts. With ``flips`` the other depth of each limb is tried where
    it looks alike (`settle_flips`).

    Raises:
        DataError: too few pictures or landmarks.
    """
    rig, settings = rig or default_rig(), settings or FitSettings()
    if len(landmarks.times_us) < _FEWEST:
        raise DataError(
            f"landmarks: the person was found in {len(landmarks.times_us)} pictures, expected at "
            f"least {_FEWEST}; a motion cannot be fitted to so few."
        )
    attached = attach(rig, landmarks.names)
    views = Views.of(cameras)
    problem = Problem(
        rig,
        prior or pose_prior(),
        make_evidence(landmarks, views, attached),
        UniformSpline.over(span_us[0] * 1e-6, span_us[1] * 1e-6, settings.knot_s),
        settings,
    )
    state = problem.state(*_first_trunk(rig, landmarks, cameras))
    state, _ = descend(problem.blunted(_BLUNT), state, _STEPS[0])
    state, price = descend(problem, state, _STEPS[1])
    doubts: tuple[Doubt, ...] = ()
    if flips:
        state, price, doubts = settle_flips(problem, state, price)
    if not math.isfinite(price):
        raise DataError("landmarks: the fit came to no finite end; look at the landmarks.")
    return PoseFit(problem, state, price, doubts)


def _first_trunk(
    rig: Rig, landmarks: Landmarks, cameras: Sequence[Camera]
) -> tuple[Tensor, Tensor, Tensor]:
    """Times (s) at which shoulders and hips were found, and the trunk there."""
    names = list(landmarks.names)
    lacking = [name for name in TRUNK if name not in names]
    if lacking:
        raise DataError(f"landmarks: hold no {', '.join(lacking)}, which a fit begins with.")
    seen = np.asarray(landmarks.seen)[:, [names.index(name) for name in TRUNK]]
    found = np.flatnonzero((seen > 0).all(1))
    if len(found) < _FEWEST:
        raise DataError(
            f"landmarks: shoulders and hips are seen in {len(found)} of {len(seen)} pictures, "
            f"expected at least {_FEWEST}; a motion cannot be fitted to so few."
        )
    views = Views.of([cameras[index] for index in found.tolist()])
    places = torch.from_numpy(np.asarray(landmarks.places, np.float64)[found])
    world = landmarks.world
    space = None if world is None else torch.from_numpy(np.asarray(world, np.float64)[found])
    trunk = first_trunk(rig, views, names, places, space)
    return _seconds(landmarks.times_us[found]), *trunk


def make_evidence(landmarks: Landmarks, views: Views, attached: Attachments) -> Evidence:
    """Of landmarks, which err by 1.2 % of the person's height at least, whatever they say."""
    index = attached.index
    places = torch.from_numpy(np.asarray(landmarks.places, np.float64))
    said = torch.from_numpy(np.asarray(landmarks.sigma_px, np.float64))[:, index]
    seen = torch.from_numpy(np.asarray(landmarks.seen, np.float64))[:, index]
    tall = _tall(places[:, index], seen > 0)
    hips = [list(landmarks.names).index(f"{side}_hip") for side in ("left", "right")]
    depths = None
    if landmarks.world is not None:
        deep = torch.from_numpy(np.asarray(landmarks.world, np.float64))[..., 2]
        depths = (deep - deep[:, hips].mean(1, keepdim=True))[:, index]
    return Evidence(
        times_s=_seconds(landmarks.times_us),
        views=views,
        points=Points(attached.origin, attached.turner, attached.offset),
        places=places[:, index],
        sigma_px=said.clamp_min(_SIZE_SHARE * tall),
        weight=torch.where(seen > 0, seen.clamp(_LEAST_WEIGHT, 1), 0) * attached.trust,
        depths=depths,
        hips=(index.tolist().index(hips[0]), index.tolist().index(hips[1])),
    )


def _tall(places: Float[Tensor, "T L 2"], seen: Bool[Tensor, "T L"]) -> float:
    """Length of what is seen of the person, pixels: the median over the pictures.

    Across rows, or columns where those are more: of somebody who lies, or before a camera on its
    side, rows are how thick they are.
    """
    high, low = (torch.where(seen[..., None], places, sign * math.inf) for sign in (-1, 1))
    spans = (high.amax(1) - low.amin(1))[seen.any(1)]
    return float(spans.median(0).values.max()) if len(spans) else math.nan


@dataclass(frozen=True, eq=False)
class FocalFit:
    """A focal length, how far it may be off, and the motion fitted with it."""

    focal_px: float
    std_share: float
    """Standard deviation of its logarithm."""
    fit: PoseFit


def fit_focal(fit: PoseFit, usual_px: float) -> FocalFit:
    """The focal length that the landmarks tell, about a ``usual_px``, by how feet, knees and hands
    grow as they come nearer.

    The mean of its logarithm over what it may be: the price at each of `_FOCALS`, from the motion
    given, is minus the logarithm of its likelihood for an independent picture (as in
    `PoseFit.errors`). The price is so flat that its least place alone says little.
    """
    logs = torch.tensor([math.log(usual_px * share) for share in _FOCALS], dtype=torch.float64)
    fits = [_with_focal(fit, math.exp(log)) for log in logs.tolist()]
    prices = torch.tensor([one.price for one in fits], dtype=torch.float64)
    likely = prices * fit.problem.independent_pictures
    likely = likely + 0.5 * ((logs - math.log(usual_px)) / _FOCAL_STD).square()
    weights = torch.softmax(-likely, 0)
    mean = float(weights @ logs)
    # Between two of the focal lengths nothing was tried: a uniform distribution there.
    step = float(logs[1] - logs[0])
    variance = float(weights @ (logs - mean).square()) + step**2 / 12
    nearest = fits[int((logs - mean).abs().argmin())]
    return FocalFit(math.exp(mean), math.sqrt(variance), _with_focal(nearest, math.exp(mean)))


def _with_focal(fit: PoseFit, focal_px: float) -> PoseFit:
    """The motion fitted anew, with another focal length."""
    evidence = fit.problem.evidence
    views = evidence.views.with_focal(focal_px)
    problem = fit.problem.with_evidence(replace(evidence, views=views))
    state, price = descend(problem, _at_focal(fit, focal_px), _STEPS[0])
    return PoseFit(problem, state, price, fit.doubts)


def _at_focal(fit: PoseFit, focal_px: float) -> State:
    """The motion moved along the view so that it looks as large with another focal length."""
    views = fit.problem.evidence.views
    centre = (-(views.rotation.mT @ views.world_to_camera[:, :3, 3:])[..., 0]).mean(0)
    control = fit.state.control.clone()
    away = views.rotation[:, 2].mean(0)
    depth = (control[:, PLACE] - centre) @ away
    ratio = focal_px / float(views.focal_px.mean()) - 1
    control[:, PLACE] += ratio * depth[:, None] * away
    return State(control, fit.state.shared)


def _seconds(times_us: Sequence[int] | np.ndarray) -> Tensor:
    return torch.as_tensor(np.asarray(times_us), dtype=torch.float64) * 1e-6


def _spread(
    rate: Float[Tensor, "T 3 C"], covariance: Float[Tensor, "T C C"]
) -> Float[np.ndarray, "T"]:
    """Root mean square over the axes of a rotation vector's standard deviation."""
    turned = rate @ covariance @ rate.mT
    mean = turned.diagonal(dim1=-2, dim2=-1).mean(-1)
    return mean.clamp_min(0).sqrt().numpy()
