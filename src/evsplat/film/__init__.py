"""How a reconstruction is filmed: where the camera goes, what the person does, what is shown."""

from evsplat.film.camera_path import (
    PATHS,
    CameraPath,
    camera_at,
    orbit,
    read_camera_path,
    swing,
    through,
)
from evsplat.film.looks import SHOWN, Look
from evsplat.film.motion import load_motion_of, place_motion
from evsplat.film.scene import Scene, rendered_instants
from evsplat.options import Film

__all__ = [
    "PATHS",
    "SHOWN",
    "CameraPath",
    "Film",
    "Look",
    "Scene",
    "camera_at",
    "load_motion_of",
    "orbit",
    "place_motion",
    "read_camera_path",
    "rendered_instants",
    "swing",
    "through",
]
