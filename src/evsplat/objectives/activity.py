"""What events of a static camera tell of pixels at which nothing moves (A8)."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import label, uniform_filter
from scipy.spatial import cKDTree
from scipy.stats import poisson

from evsplat.body import BodyTrack
from evsplat.calibration import NoiseEstimate, noise_of
from evsplat.capture import Frame, TrainingCapture
from evsplat.errors import ConfigError
from evsplat.events import EventStore, polarity_counts
from evsplat.objectives.semantic import silhouette_bounds

MOVES_PX = 2.0
"""A body that moves less than this during an exposure need not make events at its outline."""
FALSE_ALARMS = 0.01
"""Share of places at which the sensor's noise may pass for activity."""


@dataclass(frozen=True, eq=False)
class Activity:
    """Events of a static camera, and what the sensor makes of them without cause."""

    capture: TrainingCapture
    events: EventStore
    noise: NoiseEstimate

    @classmethod
    def of(cls, capture: TrainingCapture) -> "Activity":
        """Measure the noise; a `ConfigError` where there are no events or the camera moves."""
        if capture.events is None or not capture.is_static_camera:
            what = "has no events" if capture.events is None else "is of a moving camera"
            raise ConfigError(
                f"{capture.path}: {what}, and semantic_activity=true asks where a static camera's "
                "events are silent; pass --set semantic_activity=false."
            )
        return cls(capture, capture.events, noise_of(capture.events))

    def active(self, frame: Frame) -> Bool[np.ndarray, "H W"]:
        """Pixels around which the exposure had more events than noise alone would explain.

        Counted over the nine pixels around each, without hot ones.
        """
        start, end = frame.exposure_us
        size = self.events.height, self.events.width
        counts = polarity_counts(self.events.between(start, end), *size).sum(0).numpy()
        hot = self.noise.hot_pixels
        counts[hot[:, 1], hot[:, 0]] = 0
        around = np.rint(9 * uniform_filter(counts.astype(np.float64), 3, mode="constant"))
        expected = 9 * self.noise.background_hz * (end - start) * 1e-6
        return around > poisson.ppf(1 - FALSE_ALARMS, expected)

    def still_scene(
        self,
        frame: Frame,
        track: BodyTrack,
        silhouette: Bool[np.ndarray, "H W"],
        band_px: int,
    ) -> Bool[np.ndarray, "H W"]:
        """Pixels of the undecided band that are the scene's.

        Around those nothing happened; they are reached from the sure scene over such pixels alone,
        for a cloth of one colour is silent within but not at its edge; and the nearest part of the
        body moved by `MOVES_PX` in the exposure, for an edge that rests is silent as well. Activity
        decides nothing: shadows make events too.
        """
        inside, outside = (mask.numpy() for mask in silhouette_bounds(silhouette, band_px))
        return reached(outside, ~self.active(frame) & ~inside) & self._beside_motion(
            frame, track, ~inside & ~outside
        )

    def _beside_motion(
        self, frame: Frame, track: BodyTrack, band: Bool[np.ndarray, "H W"]
    ) -> Bool[np.ndarray, "H W"]:
        camera = self.capture.camera(frame)
        start, end = frame.exposure_us
        first, middle, last = (
            camera.project(track.vertices(time))[0].numpy() for time in (start, frame.mid_us, end)
        )
        moved: Float[np.ndarray, " V"] = np.linalg.norm(last - first, axis=1)
        y, x = np.nonzero(band)
        moving = np.zeros_like(band)
        if len(y):
            nearest = cKDTree(middle).query(np.stack([x, y], -1) + 0.5)[1]
            moving[y, x] = moved[nearest] > MOVES_PX
        return moving


def reached(
    start: Bool[np.ndarray, "H W"], passable: Bool[np.ndarray, "H W"]
) -> Bool[np.ndarray, "H W"]:
    """Passable pixels joined to a passable pixel of ``start`` over passable ones, by sides."""
    region, _ = label(passable)
    joined = np.unique(region[start & passable])
    return np.isin(region, joined[joined > 0])
