"""What moves and colours Gaussians: encodings, pose encoder, deformation and colour networks."""

from evsplat.deform.colour import HumanColour, SceneColour, view_jitter
from evsplat.deform.encodings import OneBlobEncoding
from evsplat.deform.non_rigid import NonRigid, NonRigidNetwork
from evsplat.deform.pose_encoder import PoseEncoder, normalise_joints
from evsplat.deform.skinning_network import HierarchicalSoftmax, SkinningNetwork
from evsplat.deform.spherical_harmonics import sh_basis

__all__ = [
    "HierarchicalSoftmax",
    "HumanColour",
    "NonRigid",
    "NonRigidNetwork",
    "OneBlobEncoding",
    "PoseEncoder",
    "SceneColour",
    "SkinningNetwork",
    "normalise_joints",
    "sh_basis",
    "view_jitter",
]
