"""What a motion is corrected by: sharp pictures, and the scene behind the person in them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.ndimage import distance_transform_edt, gaussian_filter
from torch import Tensor

from evsplat.body import BodyTrack
from evsplat.body.silhouette import track_silhouette
from evsplat.camera import Camera
from evsplat.capture import Frame, TrainingCapture
from evsplat.errors import DataError
from evsplat.landmarks.pictures import SharpPicture, sharp_pictures
from evsplat.pictures.light import DARKEST, Transfer, decode, encode, luminance, transfer_shown

_REACH = 0.08
"""The person is within this share of its height from the posed body."""
_CLEAR = 0.04
"""Beyond this share of the height from the posed body a pixel shows the background."""
_DARKEST, _BRIGHTEST = 0.3, 1.1
_LIGHT_BLUR = 0.02
"""Smoothing of shadows, share of the height."""
_FAR_PX = 1e6
_BY_PICTURE = ("coloured", "image", "behind", "weight", "trust")
_DOUBTFUL = 0.06
"""Expected error of coded colours from which on a carried pixel counts little."""


class NobodyInViewError(DataError):
    """The posed body is in too few pictures to tell anything."""


@dataclass(frozen=True, eq=False)
class Looked:
    """The N pixels of P pictures that count, picture by picture: the others tell nothing."""

    counts: Int[Tensor, "P"]
    """Of each picture."""
    ends: Int[Tensor, "P"]
    """Where each picture's end."""
    pixel: Int[Tensor, "N"]
    """Place in the picture (H, W) in a row, int32."""
    area: int
    """Pixels of a picture."""
    image: Float[Tensor, "N 3"]
    behind: Float[Tensor, "N 3"]
    weight: Float[Tensor, "N"]
    grey: Int[Tensor, "G"]
    """Those of pictures that have no colours."""

    @property
    def place(self) -> Int[Tensor, "N"]:
        """Place in (P, H, W) in a row."""
        first = self.area * torch.arange(len(self.counts))
        return first.repeat_interleave(self.counts) + self.pixel


@dataclass(frozen=True, eq=False)
class Targets:
    """P pictures of a camera that stands still."""

    times_us: list[int]
    frames: list[Frame]
    """The frame in whose exposure each lies."""
    coloured: Bool[Tensor, "P"]
    """False where events carried the picture there: they tell brightness but no hue."""
    image: Float[Tensor, "P H W 3"]
    """Coded; where not coloured, luminance thrice."""
    behind: Float[Tensor, "P H W 3"]
    """The scene without the person, in the person's shadow."""
    weight: Float[Tensor, "P H W"]
    """Trust in each pixel; 0 away from the person."""
    trust: Float[Tensor, "P H W"]
    """Trust in each pixel, wherever the person is."""
    camera: Camera
    transfer: Transfer

    def as_seen(self, drawn: Float[Tensor, "P H W 3"]) -> Float[Tensor, "P H W 3"]:
        """Drawings of these pictures, grey where the pictures are."""
        return self.greyed(drawn, torch.nonzero(~self.coloured)[:, 0])

    def greyed(self, drawn: Float[Tensor, "N *size 3"], rows: Int[Tensor, "G"]) -> Tensor:
        """Drawings of which some are grey."""
        return drawn.index_copy(0, rows, _grey(drawn[rows], self.transfer)) if len(rows) else drawn

    @cached_property
    def looked(self) -> Looked:
        """The pixels with a weight."""
        picture, row, column = torch.nonzero(self.weight, as_tuple=True)
        height, width = self.weight.shape[1:]
        counts = torch.bincount(picture, minlength=len(self.times_us))
        chosen = picture, row, column
        return Looked(
            counts,
            counts.cumsum(0),
            (row * width + column).int(),
            height * width,
            self.image[chosen],
            self.behind[chosen],
            self.weight[chosen],
            torch.nonzero(~self.coloured[picture])[:, 0],
        )

    def around(self, track: BodyTrack, nearness: float = 1.0) -> "Targets":
        """The same pictures; what is behind the person, and where it is, by another motion.

        ``nearness`` multiplies how far from the posed body the background is taken for sure.
        """
        away, tall = _distances(track, self.times_us, self.camera)
        known = self.coloured
        plain = _background(self.image[known], away[known], nearness * _CLEAR * tall)
        usual = self.as_seen(plain.expand_as(self.image))
        light = [_light(*one, nearness * tall) for one in zip(self.image, usual, away, strict=True)]
        return replace(
            self,
            behind=plain * torch.stack(light),
            weight=(away < _REACH * tall) * self.trust,
        )

    def rows(self, chosen: Sequence[int]) -> "Targets":
        """Some of the pictures."""
        index = list(chosen)
        return replace(
            self,
            times_us=[self.times_us[k] for k in index],
            frames=[self.frames[k] for k in index],
            **{name: getattr(self, name)[index] for name in _BY_PICTURE},
        )

    def smaller(self, times: int) -> "Targets":
        """Pictures of fewer pixels: means over squares of ``times`` pixels."""

        def pooled(images: Tensor) -> Tensor:
            planar = images.permute(0, 3, 1, 2)
            return torch.nn.functional.avg_pool2d(planar, times).permute(0, 2, 3, 1).contiguous()

        weight, trust = (pooled(one[..., None])[..., 0] for one in (self.weight, self.trust))
        return replace(
            self,
            image=pooled(self.image),
            behind=pooled(self.behind),
            weight=weight,
            trust=trust,
            camera=self.camera.smaller(times),
        )


def halved(camera: Camera, least_px: int) -> int:
    """By how much pictures become smaller, halved while both sides keep ``least_px``."""
    times = 1
    while min(camera.width, camera.height) >= 2 * times * least_px:
        times *= 2
    return times


def find_targets(
    track: BodyTrack,
    capture: TrainingCapture,
    pictures: Sequence[SharpPicture] | None = None,
    *,
    shrink: int = 1,
) -> Targets:
    """Sharp pictures of all times that the policy shows, with what is behind the person.

    ``pictures``: some of `sharp_pictures`, None for all. ``shrink``: pixels along each side of the
    square that becomes one.

    Raises:
        DataError: the camera moves.
        NobodyInViewError: the posed body is in few of the pictures or in none.
    """
    refuse_no_background(capture)
    if pictures is None:
        pictures = sharp_pictures(capture)
    image = torch.stack([picture.image for picture in pictures]).float()
    transfer = transfer_shown(capture.transfer(pictures[0].frame))
    coloured = torch.tensor([picture.frame.split == "train" for picture in pictures])
    image[~coloured] = _grey(image[~coloured], transfer)
    found = Targets(
        [picture.time_us for picture in pictures],
        [picture.frame for picture in pictures],
        coloured,
        image,
        image,
        torch.ones(image.shape[:3]),
        torch.stack([_trust(picture) for picture in pictures]),
        capture.camera(pictures[0].frame),
        transfer,
    )
    found = found if shrink == 1 else found.smaller(shrink)
    try:
        return found.around(track)
    except NobodyInViewError as error:
        raise NobodyInViewError(f"{capture.path}: {error}") from None


def refuse_no_background(capture: TrainingCapture) -> None:
    """A `DataError` where the camera moves, before any picture is sharpened in vain."""
    if not capture.is_static_camera:
        raise DataError(
            f"{capture.path}: has a moving camera or several, and a motion is corrected by what "
            "differs from a static background; leave the poses as they are."
        )


def _grey(coded: Float[Tensor, "*size 3"], transfer: Transfer) -> Float[Tensor, "*size 3"]:
    """Coded luminance, thrice."""
    light = luminance(decode(coded.clamp_min(DARKEST), transfer))
    return encode(light, transfer)[..., None].expand(*coded.shape)


def _trust(picture: SharpPicture) -> Float[Tensor, "H W"]:
    """Less where the two exposures that were carried to the picture's time differ."""
    doubt = picture.doubt if picture.doubt is not None else torch.zeros(picture.image.shape[:2])
    return picture.sigma**-2 / (1 + doubt / _DOUBTFUL**2)


def _distances(
    track: BodyTrack, times_us: Sequence[int], camera: Camera
) -> tuple[Float[Tensor, "P H W"], float]:
    """Pixels to the posed body at each time, and how tall it is in the pictures, in pixels.

    That is the median of its boxes' rows, or of their columns where they are more: of somebody who
    lies, or before a camera on its side, rows are how thick they are.
    """
    found, sizes = [], []
    for time_us in times_us:
        inside = track_silhouette(track, time_us, camera).numpy()
        sides = [np.flatnonzero(inside.any(axis)) for axis in (1, 0)]
        sizes.append([side[-1] - side[0] + 1 if len(side) else 0 for side in sides])
        far = np.full(inside.shape, _FAR_PX)
        found.append(distance_transform_edt(~inside) if len(sides[0]) else far)
    tall = float(np.median(sizes, axis=0).max())
    if tall == 0:
        raise NobodyInViewError(
            "the posed body is in few of the pictures or in none, so that they tell nothing of "
            "its motion; check camera and poses."
        )
    return torch.from_numpy(np.stack(found)).float(), tall


def _background(
    image: Float[Tensor, "P H W 3"], away: Float[Tensor, "P H W"], clear: float
) -> Float[Tensor, "H W 3"]:
    """Median of each pixel over the pictures in which the person is not near, or nearly so."""
    least = torch.minimum(away.amax(0), torch.tensor(clear))
    return torch.where((away >= least)[..., None], image, torch.nan).nanmedian(0).values


def _light(image: Tensor, plain: Tensor, away: Tensor, tall: float) -> Float[Tensor, "H W 1"]:
    """The share of its usual brightness that the background has: less in the person's shadow."""
    clear = (away > _CLEAR * tall).numpy().astype(np.float32)
    sigma = max(0.5, _LIGHT_BLUR * tall)
    shown = gaussian_filter(image.mean(-1).numpy() * clear, sigma)
    usual = gaussian_filter(plain.mean(-1).numpy() * clear, sigma)
    share = (shown + 1e-3) / (usual + 1e-3)
    return torch.from_numpy(np.clip(share, _DARKEST, _BRIGHTEST)).float()[..., None]
