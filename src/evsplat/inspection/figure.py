"""The posed body in coarse maps of a picture: quick silhouettes at many times."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32
from scipy.ndimage import binary_closing

from evsplat.body import BodyTrack, skin
from evsplat.body.silhouette import NEAR
from evsplat.body.surface import sample_mesh
from evsplat.camera import Camera

FIGURE_PX = 80
"""Height of the body in the maps: finer ones cost time and say no more."""
_LONGEST_PX, _SHORTEST_PX = 288, 96
_SAMPLES = 5000


@dataclass(frozen=True, eq=False)
class Coarse:
    """The pixels of the maps: pictures of one camera made smaller."""

    width: int
    height: int
    pixel: float
    """Picture pixels per map pixel."""

    @classmethod
    def of(cls, camera: Camera, figure_px: float) -> "Coarse":
        """Maps in which a body of ``figure_px`` pixels of the picture is `FIGURE_PX` high."""
        longest = max(camera.width, camera.height)
        size = longest * FIGURE_PX / max(figure_px, 1.0)
        scale = min(1.0, min(max(size, _SHORTEST_PX), _LONGEST_PX) / longest)
        width, height = max(1, round(camera.width * scale)), max(1, round(camera.height * scale))
        return cls(width, height, 1 / scale)

    def shrunk(self, picture: Float[torch.Tensor, "H W"]) -> Float32[np.ndarray, "h w"]:
        """Means over the pixels of the maps."""
        size = (self.height, self.width)
        means = torch.nn.functional.interpolate(picture[None, None].float(), size, mode="area")
        return means[0, 0].numpy()


class Figure:
    """The posed body in maps: samples of its surface, the gaps between them closed."""

    def __init__(self, track: BodyTrack) -> None:
        self._track = track
        body, generator = track.body, torch.Generator().manual_seed(0)
        self._samples = sample_mesh(
            body.rest_vertices, body.faces, body.weights, _SAMPLES, generator
        )

    def heights_px(
        self, times_us: Sequence[int], cameras: Sequence[Camera]
    ) -> Float[np.ndarray, "N"]:
        """Height or width inside of the pictures, the larger; 0 where the body is out of view."""
        sizes = []
        for pixels, camera in zip(self._projected(times_us, cameras), cameras, strict=True):
            inside = ((pixels >= 0) & (pixels < (camera.width, camera.height))).all(1)
            seen = pixels[inside]
            sizes.append(float(np.ptp(seen, axis=0).max()) if len(seen) else 0.0)
        return np.array(sizes)

    def maps(
        self, times_us: Sequence[int], cameras: Sequence[Camera], coarse: Coarse, margin: int
    ) -> Bool[np.ndarray, "N H W"]:
        """Map pixels where the body is; maps reach ``margin`` pixels further on each side."""
        wide = margin + 1  # closing needs one more
        height, width = coarse.height + 2 * wide, coarse.width + 2 * wide
        maps = np.zeros((len(times_us), height, width), bool)
        for k, pixels in enumerate(self._projected(times_us, cameras)):
            scale = (coarse.width / cameras[k].width, coarse.height / cameras[k].height)
            place = np.floor(pixels * scale) + wide
            column, row = place[((place >= 0) & (place < (width, height))).all(1)].astype(int).T
            maps[k, row, column] = True
        return binary_closing(maps, np.ones((1, 3, 3)))[:, 1:-1, 1:-1]

    def _projected(
        self, times_us: Sequence[int], cameras: Sequence[Camera]
    ) -> list[Float[np.ndarray, "N 2"]]:
        """Pixels of the samples before the camera, at each time."""
        pixels = []
        bones = self._track.body.bone_transforms(*self._track.at(times_us))
        for one, camera in zip(bones.split(1), cameras, strict=True):
            points = skin(self._samples.points, self._samples.weights, one)[0][0]
            place, depth = camera.project(points)
            pixels.append(place[depth > NEAR].numpy())
        return pixels


def grown(maps: Bool[np.ndarray, "N H W"]) -> Bool[np.ndarray, "N H W"]:
    """Silhouettes widened by a pixel up, down, left and right."""
    wider = maps.copy()
    wider[:, 1:] |= maps[:, :-1]
    wider[:, :-1] |= maps[:, 1:]
    wider[:, :, 1:] |= maps[:, :, :-1]
    wider[:, :, :-1] |= maps[:, :, 1:]
    return wider


def outlines(maps: Bool[np.ndarray, "N H W"]) -> Bool[np.ndarray, "N H W"]:
    """The outlines of silhouettes: a pixel outside and two inside."""
    return grown(maps) & grown(grown(~maps))
