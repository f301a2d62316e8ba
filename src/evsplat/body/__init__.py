"""Body models behind one small interface, body tracks over time, skinning."""

from evsplat.body.body import Body, bounding_box, skin, skin_with_linear
from evsplat.body.make import default_body, make_body
from evsplat.body.pose_errors import POSE_SOURCES, PoseErrors, PoseSource
from evsplat.body.retarget import SkeletonMotion, retarget
from evsplat.body.rotations import axis_angle_to_matrix
from evsplat.body.silhouette import body_box, silhouette, track_silhouette
from evsplat.body.surface import SurfaceSamples
from evsplat.body.track import BodyTrack, nearest_axis, up_axis

__all__ = [
    "POSE_SOURCES",
    "Body",
    "BodyTrack",
    "PoseErrors",
    "PoseSource",
    "SkeletonMotion",
    "SurfaceSamples",
    "axis_angle_to_matrix",
    "body_box",
    "bounding_box",
    "default_body",
    "make_body",
    "nearest_axis",
    "retarget",
    "silhouette",
    "skin",
    "skin_with_linear",
    "track_silhouette",
    "up_axis",
]
