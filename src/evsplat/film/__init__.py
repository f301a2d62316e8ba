"""Films of a reconstruction: camera paths, motions, and the values that pixels show."""

from evsplat.film.camera_path import camera_at
from evsplat.film.looks import Look
from evsplat.film.motion import load_motion_of
from evsplat.film.plan import FilmPlan
from evsplat.options import Film

__all__ = ["Film", "FilmPlan", "Look", "camera_at", "load_motion_of"]
