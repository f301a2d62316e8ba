"""Films of a reconstruction: camera paths, motions, and the values that pixels show."""

from evsplat.film.looks import Look
from evsplat.film.motion import load_motion_of
from evsplat.film.plan import FilmPlan
from evsplat.options import Film

__all__ = ["Film", "FilmPlan", "Look", "load_motion_of"]
