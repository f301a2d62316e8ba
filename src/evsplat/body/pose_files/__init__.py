"""Body poses that other tools estimated."""

from evsplat.body.pose_files.read import FORMATS, read_poses
from evsplat.body.pose_files.sequence import PoseSequence
from evsplat.body.pose_files.transfer import skeleton_motion, to_default_body

__all__ = ["FORMATS", "PoseSequence", "read_poses", "skeleton_motion", "to_default_body"]
