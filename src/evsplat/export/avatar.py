"""The avatar: Gaussians with four bones each, motion clips, and a page that plays them."""

import base64
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from torch import Tensor

from evsplat.body import BodyTrack, up_axis
from evsplat.body.rotations import matrix_to_quaternion
from evsplat.camera import Camera
from evsplat.errors import DataError
from evsplat.export.cloud import SplatCloud, cloud_of
from evsplat.export.formats import write_ply
from evsplat.export.presets import joint_labels, presets, quaternions_of
from evsplat.files import new_folder, write_json, write_text
from evsplat.models.at_rest import SkinnedGaussians
from evsplat.models.correctives import Correctives
from evsplat.models.discs.shading import SurfaceLight
from evsplat.pictures import Transfer
from evsplat.training.reconstruction import GaussianReconstruction

BONES_EACH = 4
_MOST_JOINTS = 256
KEYS_PER_SECOND = 60.0
FORMAT, VERSION = "evsplat-avatar", 5
_PLAYER = files("evsplat") / "data" / "player"
_SCRIPTS = ("splats.js", "skeleton.js", "orbit.js", "player.js")
_README = """An avatar made by evsplat.

index.html     opens in any browser with WebGL 2, without a network: plays, orbits, poses
avatar.json    skeleton, motions and skin weights; the format is in evsplat's docs/export.md
gaussians.ply  the person at rest (canonical pose), 3D Gaussian splatting layout, metres
scene.ply      what stands around, in the axes of the capture (where it was asked for)
"""


@dataclass(frozen=True, eq=False)
class FourBones:
    """Which bones each Gaussian follows, at most four, as graphics cards like it."""

    bones: UInt8[np.ndarray, "H 4"]
    """Joint numbers, heaviest first."""
    weights: UInt8[np.ndarray, "H 4"]
    """Skinning weights; they sum to 255."""

    def __len__(self) -> int:
        """Number of Gaussians."""
        return len(self.bones)

    def dense(self, joints: int) -> Float[Tensor, "H J"]:
        """The same weights for every joint; rows sum to 1."""
        weights = torch.zeros(len(self), joints)
        # Unused places have no weight, and bone 0.
        return weights.scatter_add_(
            1, torch.from_numpy(self.bones).long(), torch.from_numpy(self.weights) / 255
        )


@dataclass(frozen=True, eq=False)
class Elsewhere:
    """What differs in poses that were not recorded."""

    skin: FourBones
    """With which neighbours stay together."""
    sizes: UInt8[np.ndarray, " H"]
    """Factors on the standard deviations, in 255ths: less where a Gaussian reaches off the body."""


@dataclass(frozen=True, eq=False)
class Avatar:
    """A person whose every Gaussian follows at most four bones."""

    gaussians: SkinnedGaussians
    """Gaussians at rest; their weights are those of ``skin``."""
    skin: FourBones
    """In recorded poses."""
    elsewhere: Elsewhere | None
    """In all other poses; None: as in recorded ones."""


@dataclass(frozen=True, eq=False)
class Clip:
    """A motion: poses at an even rate."""

    name: str
    rate_hz: float
    rotations: Float32[np.ndarray, "T J 4"]
    """Against the parent, (w, x, y, z); the root's in the world."""
    transl: Float32[np.ndarray, "T 3"]
    """Root joint's shift from its rest place, metres."""


def avatar_of(
    gaussians: SkinnedGaussians,
    elsewhere: tuple[Float[Tensor, "H J"], Float[Tensor, " H"]] | None = None,
) -> Avatar:
    """Keep four bones of each Gaussian.

    ``elsewhere``: weights, and factors (0..1) on the sizes, in poses that were not recorded.
    """
    skin = four_bones(gaussians.weights)
    weights = skin.dense(gaussians.weights.shape[1])
    other = None
    if elsewhere is not None:
        even, sizes = elsewhere
        other = Elsewhere(four_bones(even), (255 * sizes).round().to(torch.uint8).numpy())
    return Avatar(replace(gaussians, weights=weights), skin, other)


def four_bones(weights: Float[Tensor, "H J"]) -> FourBones:
    """Keep the four heaviest bones of each Gaussian, in 255ths; the rest is shared among them."""
    joints = weights.shape[1]
    if joints > _MOST_JOINTS:
        raise DataError(f"The body has {joints} joints; an avatar holds up to {_MOST_JOINTS}.")
    kept, bones = weights.double().topk(min(BONES_EACH, joints), dim=1)
    exact = kept / kept.sum(1, keepdim=True) * 255
    whole = exact.floor()
    # The largest remainders take what is missing to 255.
    missing = (255 - whole.sum(1, keepdim=True)).round()
    rank = (exact - whole).argsort(1, descending=True).argsort(1)
    shares = whole + (rank < missing)
    padding = (0, BONES_EACH - bones.shape[1])
    return FourBones(
        bones=torch.nn.functional.pad(bones, padding).to(torch.uint8).numpy(),
        weights=torch.nn.functional.pad(shares, padding).to(torch.uint8).numpy(),
    )


def recorded_clip(source: GaussianReconstruction, times_us: tuple[int, int]) -> Clip:
    """The recorded motion from the first to the second time, as the method corrected it."""
    times = _even_times(*times_us)
    rotations, bones = source.pose(times)
    body = source.track.body.to("cpu")
    root = body.rest_joints[0]
    # Canonical to world after rest to canonical: where the root's rest place goes.
    placed = bones[:, 0] @ body.canonical_bone_transforms()[0]
    transl = placed[:, :3, :3] @ root + placed[:, :3, 3] - root
    return _clip("recorded", rotations, transl)


def clip_of(name: str, track: BodyTrack) -> Clip:
    """Any other motion of the same body."""
    times = _even_times(int(track.times_us[0]), int(track.times_us[-1]))
    return _clip(name, *track.at(times))


def _clip(name: str, rotations: Tensor, transl: Tensor) -> Clip:
    quaternions = on_one_side(matrix_to_quaternion(rotations.double()).numpy())
    return Clip(name, KEYS_PER_SECOND, quaternions.astype(np.float32), transl.numpy())


def on_one_side(quaternions: Float[np.ndarray, "T J 4"]) -> Float[np.ndarray, "T J 4"]:
    """The same rotations, of which a player may interpolate neighbouring keys as they are."""
    turned = (quaternions[1:] * quaternions[:-1]).sum(-1) < 0
    signs = np.where(np.cumsum(turned, axis=0) % 2 == 1, -1.0, 1.0)
    return np.concatenate([quaternions[:1], quaternions[1:] * signs[..., None]])


def _even_times(first: int, last: int) -> list[int]:
    count = 1 + int((last - first) * KEYS_PER_SECOND / 1e6)
    return [first + round(k * 1e6 / KEYS_PER_SECOND) for k in range(count)]


def write_avatar(
    path: Path | str,
    avatar: Avatar,
    clips: Sequence[Clip],
    *,
    track: BodyTrack,
    camera: Camera,
    scene: SplatCloud | None,
    transfer: Transfer,
    facts: Mapping[str, Any],
) -> Path:
    """Write one self-contained page where ``path`` ends in .html, else a folder around it.

    ``camera`` is where the page starts to look from; ``scene`` stands around the person if given;
    ``transfer`` is that of the colours of both: the page draws light as light, and codes it to show
    it, as the .ply files hold it. ``facts`` are shown (``note``) and kept. Returns the page.
    """
    path = Path(path)
    document = avatar_document(
        avatar, clips, track=track, camera=camera, transfer=transfer, facts=facts
    )
    cloud = cloud_of(avatar.gaussians.at_rest())
    page = _page(document, cloud, scene)
    if path.suffix.lower() in (".html", ".htm"):
        write_text(path, page)
        return path
    with new_folder(path) as folder:
        write_text(folder / "index.html", page)
        write_json(folder / "avatar.json", document)
        comments = ["written by evsplat", "unit: metre"]
        write_ply(folder / "gaussians.ply", cloud.shown(transfer), comments=comments)
        if scene is not None:
            write_ply(folder / "scene.ply", scene.shown(transfer), comments=comments)
        write_text(folder / "README.txt", _README)
    return path / "index.html"


def avatar_document(
    avatar: Avatar,
    clips: Sequence[Clip],
    *,
    track: BodyTrack,
    camera: Camera,
    transfer: Transfer,
    facts: Mapping[str, Any],
) -> dict[str, Any]:
    """Content of avatar.json; arrays are base64 of little-endian numbers, rows after rows."""
    body = avatar.gaussians.body
    light, correctives = avatar.gaussians.light, avatar.gaussians.correctives
    inverse = torch.linalg.inv(body.canonical_bone_transforms().double())
    return {
        "format": FORMAT,
        "version": VERSION,
        **facts,
        "unit": "metre",
        "transfer": transfer,
        "up": [float(v) for v in up_axis(track)],
        "camera": {
            "width": camera.width,
            "height": camera.height,
            "K": camera.K.tolist(),
            "world_to_camera": camera.world_to_camera.tolist(),
        },
        "skeleton": {
            "names": list(body.joint_names),
            "labels": joint_labels(body),
            "parents": body.parents.tolist(),
            "rest": body.rest_joints.tolist(),
            "rest_from_canonical": [row.tolist() for row in inverse.float()],
        },
        "skin": {
            "count": len(avatar.skin),
            **_skin(avatar.skin),
            "elsewhere": None if avatar.elsewhere is None else _elsewhere(avatar.elsewhere),
        },
        "light": None if light is None else _light(light),
        "correctives": None if correctives is None else _correctives(correctives),
        "presets": [
            {
                "name": preset.name,
                "rotations": quaternions_of(preset.rotations),
                "transl": preset.transl.tolist(),
            }
            for preset in presets(track, int(track.times_us[len(track.times_us) // 2]))
        ],
        "clips": [
            {
                "name": clip.name,
                "rate_hz": clip.rate_hz,
                "count": len(clip.rotations),
                "rotations": _base64(clip.rotations, "<f4"),
                "transl": _base64(clip.transl, "<f4"),
            }
            for clip in clips
        ],
    }


def _page(document: Mapping[str, Any], person: SplatCloud, scene: SplatCloud | None) -> str:
    """Player and data in one page."""
    data = {**document, "person": _cloud(person), "scene": None if scene is None else _cloud(scene)}
    if len(person) != document["skin"]["count"]:
        raise DataError("Some Gaussians of the person are not finite; train the run longer.")
    page = _asset("page.html")
    parts = {
        "STYLE": _asset("player.css"),
        # Inside a script "</script" would end it, and "<!--<script" keep it from ending.
        "DATA": json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c"),
        "SCRIPT": "\n".join(_asset(name) for name in _SCRIPTS),
    }
    return re.sub(r"/\*(STYLE|DATA|SCRIPT)\*/", lambda match: parts[match[1]], page)


def _asset(name: str) -> str:
    return (_PLAYER / name).read_text(encoding="utf-8")


def _cloud(cloud: SplatCloud) -> dict[str, Any]:
    """14 float32 per Gaussian: centre, rotation (w, x, y, z), scales, opacity, RGB."""
    columns = (cloud.means, cloud.quaternions, cloud.scales, cloud.opacities[:, None], cloud.rgb)
    return {"count": len(cloud), "values": _base64(np.concatenate(columns, axis=1), "<f4")}


def _skin(skin: FourBones) -> dict[str, Any]:
    return {"bones": _base64(skin.bones, "u1"), "weights": _base64(skin.weights, "u1")}


def _elsewhere(elsewhere: Elsewhere) -> dict[str, Any]:
    return {**_skin(elsewhere.skin), "sizes": _base64(elsewhere.sizes, "u1")}


def _light(light: SurfaceLight) -> dict[str, Any]:
    shading = light.shading
    return {
        "center": shading.center.tolist(),
        "radius_m": float(shading.radius_m),
        "coefficients": shading.coefficients.tolist(),
        "lamps": [] if light.lamps is None else light.lamps.tolist(),
        "intensities": shading.intensities.tolist(),
        "normals": _base64(light.normals.numpy(), "<f4"),
    }


def _correctives(correctives: Correctives) -> dict[str, Any]:
    return {
        "count": len(correctives.values),
        "low": correctives.low.tolist(),
        "high": correctives.high.tolist(),
        "linear": _base64(correctives.linear.numpy(), "<f4"),
        "constant": correctives.constant.tolist(),
        "least": correctives.least.tolist(),
        "most": correctives.most.tolist(),
        "reach": correctives.reach,
        "steps": correctives.steps.tolist(),
        "values": _base64(correctives.values.numpy(), "i1"),
    }


def _base64(values: np.ndarray, kind: str) -> str:
    return base64.b64encode(np.ascontiguousarray(values, dtype=kind).tobytes()).decode("ascii")
