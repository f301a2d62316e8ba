"""Starts of a method's Gaussians: the person's on the body, the scene's behind it."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from evsplat.body import BodyTrack, skin, up_axis
from evsplat.capture import Camera, Frame, TrainingCapture
from evsplat.config import settings
from evsplat.errors import ConfigError
from evsplat.gaussians import FEATURE_DIM
from evsplat.gaussians.flip import carry
from evsplat.gaussians.initialise import (
    backdrop_depth,
    facing,
    gaussians_at,
    median_backdrop,
    nearest_spacing,
    random_cube,
)
from evsplat.gaussians.surround import margins, surround
from evsplat.methods.furniture import behind_things
from evsplat.methods.room import Room
from evsplat.ranges import Above, AtLeast, ReadIf

MOST_SAMPLES = 20_000
"""Upper bound of the automatic number of samples of the person."""
CUBE_OPACITY, BACKDROP_OPACITY = 0.1, 0.9
BACKDROP_EDGE_SHARE = 0.18
"""Share of all pixels, those of strongest gradient, that get a Gaussian of their own."""
BACKDROP_MARGIN = 0.15
"""Distance of the wall behind the deepest body point, as a fraction of its depth."""

_STRIDE, _FRAMES_AT_ONCE = 7, 64
"""Of the vertices of the body that lie before the backdrop, and of frames, in one piece."""
BODY_FRAMES = 512
"""Training frames, at most, that tell where the person goes."""

_CUBE = ReadIf("scene.kind", "random_cube", lambda kind: kind == "random_cube")
_BACKDROP = ReadIf("scene.kind", "median_backdrop", lambda kind: kind == "median_backdrop")


@dataclass(frozen=True)
class HumanStart:
    """Number of the person's Gaussians at the start, samples of the body's surface."""

    count: Annotated[int, AtLeast(1)] | None
    """Number of surface samples. 3DGS-Avatar takes 50,000; null = as many as ``spacing_px`` asks
    for, at most 20,000, since a person of 4,000 pixels needs no 50,000 Gaussians."""
    spacing_px: Annotated[float, Above(0), ReadIf("count", "null", lambda n: n is None)]
    """Mean distance of neighbouring samples on the screen when ``count`` is null."""


@dataclass(frozen=True)
class Surface:
    """Shape of the person's Gaussians at the start; by default round and faint, as 3DGS-Avatar."""

    opacity: float = 0.1
    width: float = 1.0
    """Standard deviation along the surface as a share of the distance between neighbours."""
    flatness: float = 1.0
    """Standard deviation along the normal as a share of the one along the surface."""
    fewest: int = 2_000
    """Lower bound of the automatic number of samples, of a person who is small in the picture."""


@dataclass(frozen=True)
class SceneStart:
    """Start of the scene's Gaussians (A21: unsaid in the paper)."""

    kind: Literal["median_backdrop", "random_cube"]
    """``random_cube``: as HUGS in the paper, needs far more steps. ``median_backdrop``: the
    temporal median of the training frames on a floor and a wall; static cameras, and with
    `evsplat` cameras that move on one side of the scene."""
    cube_count: Annotated[int, AtLeast(4), _CUBE]
    """Points of the random cube."""
    cube_half_side_m: Annotated[float, Above(0), _CUBE] | None
    """Half side of the cube; null = the larger of 2 m and 1.5 times the camera's distance."""
    cube_max_count: Annotated[int, AtLeast(1), _CUBE]
    """No clone or split of the scene beyond this number of Gaussians; a median backdrop does not
    grow."""
    backdrop_stride_px: Annotated[int, AtLeast(1), _BACKDROP]
    """The sheet has one Gaussian per square of this side."""

    @property
    def growth_limit(self) -> int | None:
        """``cube_max_count`` where there is a cube; None: the scene does not grow."""
        return self.cube_max_count if self.kind == "random_cube" else None


@dataclass(frozen=True)
class FittedScene(SceneStart):
    """A start that is fitted to the median of the training frames."""

    prefit_steps: Annotated[int, AtLeast(0), _BACKDROP]
    """Steps of fitting the sheet to the median before training proper."""


@dataclass(frozen=True, eq=False)
class Backdrop:
    """What the sheet behind the person is to show."""

    camera: Camera
    """Sees all of it."""
    picture: Float[Tensor, "H W 3"]
    """In ``camera``, as the frames are coded."""
    margin: float = BACKDROP_MARGIN
    """Distance of the wall behind the deepest body point, as a fraction of its depth."""
    depth_shares: Float[Tensor, "H W"] | None = None
    """Depth of the scene as a share of that of floor and wall, where frames tell it."""
    room: Room | None = None
    """In place of the floor and of the wall at ``margin``, where the picture tells it."""


FROM_MEDIAN = FittedScene(
    kind="median_backdrop",
    cube_count=100_000,
    cube_half_side_m=None,
    cube_max_count=150_000,
    backdrop_stride_px=2,
    prefit_steps=300,
)
"""The scene's start of `paper` and `evsplat`."""


def human_start(
    config: HumanStart,
    surface: Surface,
    capture: TrainingCapture,
    track: BodyTrack,
    generator: torch.Generator,
    semantic_logit: float,
    feature_dim: int | None = FEATURE_DIM,
) -> dict[str, Tensor]:
    """Start values of the person's Gaussians, see `gaussians_at`."""
    count = config.count or _automatic_count(config, surface.fewest, capture, track)
    samples = track.body.sample_surface(count, generator)
    scales = surface.width * nearest_spacing(samples.points)[:, None].repeat(1, 3)
    scales[:, 2] *= surface.flatness
    return gaussians_at(
        samples.points,
        scales,
        opacity=surface.opacity,
        quaternions=None if surface.flatness == 1.0 else facing(samples.normals),
        semantic_logit=semantic_logit,
        feature_dim=feature_dim,
    )


def _automatic_count(
    config: HumanStart, fewest: int, capture: TrainingCapture, track: BodyTrack
) -> int:
    """Surface samples so that neighbours lie ``spacing_px`` apart at the person's distance."""
    vertices = track.body.canonical_vertices()
    corners = vertices[track.body.faces]
    area = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area_m2 = float(area.norm(dim=-1).sum() / 2)
    frame = capture.train_frames[len(capture.train_frames) // 2]
    camera = capture.camera(frame)
    _, depth = camera.project(track.vertices(frame.mid_us))
    pixels_per_metre = float(camera.K[0, 0] / depth.median().clamp_min(0.1))
    count = area_m2 * (pixels_per_metre / config.spacing_px) ** 2
    return int(min(max(count, fewest), MOST_SAMPLES))


def cube(start: SceneStart, capture: TrainingCapture, track: BodyTrack) -> tuple[Tensor, float]:
    """Middle of the random cube, where the person goes, and half its side, metres."""
    translation = track.at([frame.mid_us for frame in capture.train_frames])[1]
    middle = (track.body.rest_joints[0] + translation).mean(0)
    distance = float((middle - capture.camera(capture.train_frames[0]).center()).norm())
    return middle, start.cube_half_side_m or max(2.0, 1.5 * distance)


def posed(track: BodyTrack, frames: Sequence[Frame]) -> Iterator[Float[Tensor, "M 3"]]:
    """Every `_STRIDE`-th vertex of the body at the frames, some frames at a time."""
    points, weights = (
        values[::_STRIDE] for values in (track.body.canonical_vertices(), track.body.weights)
    )
    for first in range(0, len(frames), _FRAMES_AT_ONCE):
        times = [frame.mid_us for frame in frames[first : first + _FRAMES_AT_ONCE]]
        yield skin(points, weights, track.bones(times))[0].flatten(0, 1)


def places(capture: TrainingCapture, track: BodyTrack) -> Float[Tensor, "M 3"]:
    """Where the person goes: every `_STRIDE`-th vertex at `BODY_FRAMES` training frames at most."""
    frames = capture.train_frames
    return torch.cat([*posed(track, frames[:: -(-len(frames) // BODY_FRAMES)])])


def scene_start(
    start: SceneStart,
    capture: TrainingCapture,
    track: BodyTrack,
    generator: torch.Generator,
    semantic_logit: float,
    feature_dim: int | None = FEATURE_DIM,
    background: Backdrop | None = None,
    goes_on: bool = False,
) -> tuple[dict[str, Tensor], Tensor]:
    """Start values of the scene's Gaussians, and the colours, sRGB, that they shall show.

    The colours are those of the cube's points, or of the rows within the backdrop's picture, which
    come first.

    ``background``: what a backdrop shows instead of the median of the training frames.
    ``goes_on``: a backdrop goes on beyond the borders of the recorded picture.
    """
    frames = capture.train_frames
    around: list[dict[str, Tensor]] = []
    if start.kind == "random_cube":
        points, colours = random_cube(*cube(start, capture, track), start.cube_count, generator)
        scales = nearest_spacing(points)[:, None].repeat(1, 3)
        opacity = CUBE_OPACITY
    else:
        backdrop = background or _median(capture, start)
        camera, picture = backdrop.camera, backdrop.picture
        beyond = margins(camera)
        wide = camera.widened(*beyond)
        if backdrop.room is not None:
            depth = backdrop.room.depth(wide)
        else:
            depth = backdrop_depth(
                wide, posed(track, frames), up=up_axis(track), margin=backdrop.margin
            )
        if backdrop.depth_shares is not None:
            sides = beyond[0], beyond[0], beyond[1], beyond[1]
            depth = depth * pad(backdrop.depth_shares[None], sides, mode="replicate")[0]
        points, scales, colours = median_backdrop(
            camera,
            picture,
            depth[beyond[1] : -beyond[1], beyond[0] : -beyond[0]],
            stride=start.backdrop_stride_px,
            edge_points=int(BACKDROP_EDGE_SHARE * camera.width * camera.height),
        )
        opacity = BACKDROP_OPACITY
        if goes_on:
            around = [surround(wide, picture, depth, semantic_logit, feature_dim)]
        if backdrop.room is not None and backdrop.depth_shares is not None:
            behind = behind_things(
                camera, picture, backdrop.room.depth(camera), backdrop.depth_shares
            )
            around.append(
                gaussians_at(
                    *behind[:2],
                    opacity=opacity,
                    semantic_logit=semantic_logit,
                    rgb_srgb=behind[2],
                    feature_dim=feature_dim,
                )
            )
    values = gaussians_at(
        points,
        scales,
        opacity=opacity,
        semantic_logit=semantic_logit,
        rgb_srgb=colours,
        feature_dim=feature_dim,
    )
    return {
        name: torch.cat([value, *(each[name] for each in around)]) for name, value in values.items()
    }, colours


def _median(capture: TrainingCapture, start: SceneStart) -> Backdrop:
    """The median of the training frames, of a camera that stands still."""
    if not capture.is_static_camera:
        of_backdrops = " and ".join(
            f"scene.{setting.name}"
            for setting in settings(start)
            if any(condition is _BACKDROP for _, condition in setting.conditions)
        )
        raise ConfigError(
            f"{capture.path}: scene.kind is median_backdrop, which needs one static camera; "
            "this capture's camera moves. Train method evsplat, or pass --set "
            f"scene.kind=random_cube and leave out what only backdrops read: {of_backdrops}."
        )
    return Backdrop(capture.camera(capture.train_frames[0]), capture.median_background())


def as_person(scene: dict[str, Tensor], track: BodyTrack, time_us: int) -> dict[str, Tensor]:
    """A scene's start as if it were part of the person: it follows the root bone.

    At ``time_us`` it then lies where the scene was.
    """
    root = int((track.body.parents < 0).nonzero()[0, 0])
    to_canonical = torch.linalg.inv(track.bones([time_us])[0, root])
    values = {name: value.clone() for name, value in scene.items()}
    rows = torch.arange(len(values["means"]))
    carry(values, rows, to_canonical.expand(len(rows), 4, 4))
    return values


def no_gaussians() -> dict[str, Tensor]:
    """The start of a class that is empty."""
    return gaussians_at(torch.zeros(0, 3), torch.ones(0, 3), opacity=0.5, semantic_logit=0.0)
