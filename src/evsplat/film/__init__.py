"""Films of a reconstruction: camera paths, motions, and the values that pixels show."""

from evsplat.film.camera_path import (
    CameraPath,
    camera_at,
    orbit,
    read_camera_path,
    swing,
    through,
)
from evsplat.film.looks import Look
from evsplat.film.motion import load_motion_of, place_motion
from evsplat.film.plan import FilmPlan
from evsplat.options import Film

__all__ = [
    "CameraPath",
    "Film",
    "FilmPlan",
    "Look",
    "camera_at",
    "load_motion_of",
    "orbit",
    "place_motion",
    "read_camera_path",
    "swing",
    "through",
]
