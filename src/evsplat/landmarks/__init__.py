"""Landmarks of the person in pictures: found by a network or read from files of key points."""

from evsplat.landmarks.keypoints import read_keypoints
from evsplat.landmarks.landmarks import (
    BLAZEPOSE_33,
    COCO_17,
    OPENPOSE_25,
    SETS,
    WHOLEBODY_133,
    Landmarks,
)
from evsplat.landmarks.network import LandmarkNetwork
from evsplat.landmarks.pictures import SharpPicture, sharp_pictures
from evsplat.landmarks.track import find_landmarks

__all__ = [
    "BLAZEPOSE_33",
    "COCO_17",
    "OPENPOSE_25",
    "SETS",
    "WHOLEBODY_133",
    "LandmarkNetwork",
    "Landmarks",
    "SharpPicture",
    "find_landmarks",
    "read_keypoints",
    "sharp_pictures",
]
