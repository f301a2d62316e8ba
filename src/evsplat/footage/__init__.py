"""Ordinary footage: a video file or a folder of pictures, read as pictures with times."""

from evsplat.footage.footage import Footage, TimedPicture, open_footage

__all__ = ["Footage", "TimedPicture", "open_footage"]
