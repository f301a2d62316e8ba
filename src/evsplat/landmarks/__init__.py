"""Landmarks of the person in pictures: found by a network or read from files of key points."""

from evsplat.landmarks.landmarks import (
    BLAZEPOSE_33,
    COCO_17,
    OPENPOSE_25,
    WHOLEBODY_133,
    Landmarks,
)
from evsplat.landmarks.pictures import SharpPicture, sharp_pictures

__all__ = [
    "BLAZEPOSE_33",
    "COCO_17",
    "OPENPOSE_25",
    "WHOLEBODY_133",
    "Landmarks",
    "SharpPicture",
    "sharp_pictures",
]
