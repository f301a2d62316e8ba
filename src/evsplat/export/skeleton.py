"""Motion as files that animation programs read: ``.bvh`` and an animated glTF skeleton."""

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from evsplat.body import Body
from evsplat.export.avatar import Clip, clip_of, on_one_side, recorded_clip
from evsplat.export.formats import glb_bytes
from evsplat.export.gaussians import facts_of, file_rotation, rest_track
from evsplat.files import write_bytes, write_text
from evsplat.film import load_motion_of
from evsplat.options import ExportOptions
from evsplat.options.runs import MotionKind
from evsplat.training.run import Run

logger = logging.getLogger(__name__)

_FLOAT = 5126
_END_SHARE = 0.5
"""Length of a last bone as a share of the bone before it: bodies do not say where it ends."""


@dataclass(frozen=True, eq=False)
class FileMotion:
    """A motion in the axes of a file: metres, +Y up; T keys, J joints."""

    names: tuple[str, ...]
    parents: tuple[int, ...]
    """-1 for the root; parents come before their children."""
    offsets: Float[np.ndarray, "J 3"]
    """From the parent at rest; the root's from the origin."""
    rotations: Float[np.ndarray, "T J 3 3"]
    """Against the parent, the root's in the world of the file."""
    root: Float[np.ndarray, "T 3"]
    """The root joint in that world."""
    rate_hz: float


def file_motion(clip: Clip, body: Body, world_to_file: Float[np.ndarray, "3 3"]) -> FileMotion:
    """A clip with both its world and its rest pose turned to y up."""
    rest_to_file = file_rotation(rest_track(body), "gltf", None)
    count, joints = clip.rotations.shape[:2]
    quaternions = clip.rotations.reshape(-1, 4)[:, [1, 2, 3, 0]]
    local = Rotation.from_quat(quaternions).as_matrix().reshape(count, joints, 3, 3)
    turned = rest_to_file @ local @ rest_to_file.T
    parents = tuple(body.parents.tolist())
    root = parents.index(-1)
    turned[:, root] = world_to_file @ local[:, root] @ rest_to_file.T
    rest = body.rest_joints.cpu().double().numpy()
    offsets = np.array(
        [rest[j] - (rest[above] if above >= 0 else 0) for j, above in enumerate(parents)]
    )
    return FileMotion(
        names=tuple("_".join(name.split()) for name in body.joint_names),
        parents=parents,
        offsets=offsets @ rest_to_file.T,
        rotations=turned,
        root=(clip.transl.astype(np.float64) + rest[root]) @ world_to_file.T,
        rate_hz=clip.rate_hz,
    )


def export_motion(run: Run, path: Path, kind: MotionKind, options: ExportOptions) -> Path:
    """Write the recorded motion of a run, as the method corrected it, or another of its body."""
    source = run.reconstruction
    if options.motion is None:
        mids = [frame.mid_us for frame in run.capture.frames]
        clip, track = recorded_clip(source, (min(mids), max(mids))), source.track
    else:
        track = load_motion_of(options.motion, source.track, fps=options.motion_fps)
        clip = clip_of(Path(options.motion).stem, track)
    made = file_motion(clip, track.body.to("cpu"), file_rotation(track, "gltf", None))
    if kind == "bvh":
        write_bvh(path, made)
    else:
        write_skeleton(path, made, name=clip.name, extras={**facts_of(run), "unit": "metre"})
    logger.info(
        "Motion %s: %d joints, %d keys, %g per second; metres, y up.",
        clip.name,
        len(made.names),
        len(made.root),
        made.rate_hz,
    )
    return path


def write_bvh(path: Path | str, motion: FileMotion) -> None:
    """Write a Biovision hierarchy: root position, then rotations in the order Z, X, Y, degrees.

    The root's offset is zero: some programs add it to the position channels, others do not.
    """
    order: list[int] = []
    lines = ["HIERARCHY"]
    children: dict[int, list[int]] = {}
    for joint, above in enumerate(motion.parents):
        children.setdefault(above, []).append(joint)

    def vector(values: np.ndarray) -> str:
        return " ".join(f"{value:.6f}" for value in values)

    def add(joint: int, depth: int) -> None:
        order.append(joint)
        indent = "  " * depth
        rotations = "Zrotation Xrotation Yrotation"
        channels = f"6 Xposition Yposition Zposition {rotations}" if not depth else f"3 {rotations}"
        lines.append(f"{indent}{'JOINT' if depth else 'ROOT'} {motion.names[joint]}")
        lines.append(f"{indent}{{")
        offset = motion.offsets[joint] if depth else np.zeros(3)
        lines.append(f"{indent}  OFFSET {vector(offset)}")
        lines.append(f"{indent}  CHANNELS {channels}")
        for child in children.get(joint, []):
            add(child, depth + 1)
        if joint not in children:
            end = _END_SHARE * motion.offsets[joint]
            lines.extend([f"{indent}  End Site", f"{indent}  {{"])
            lines.extend([f"{indent}    OFFSET {vector(end)}", f"{indent}  }}"])
        lines.append(f"{indent}}}")

    add(children[-1][0], 0)
    count = len(motion.root)
    turns = Rotation.from_matrix(motion.rotations[:, order].reshape(-1, 3, 3))
    angles = turns.as_euler("ZXY", degrees=True).reshape(count, -1, 3)
    # No jumps of whole turns: programs interpolate the numbers.
    angles = np.unwrap(angles, axis=0, period=360)
    rows = np.concatenate([motion.root, angles.reshape(count, -1)], axis=1)
    lines += ["MOTION", f"Frames: {count}", f"Frame Time: {1 / motion.rate_hz:.8f}"]
    lines += [vector(row) for row in rows]
    write_text(Path(path), "\n".join(lines) + "\n")


def write_skeleton(
    path: Path | str, motion: FileMotion, *, name: str, extras: Mapping[str, Any] | None = None
) -> None:
    """Write binary glTF 2.0: a node per joint, a skin that names them, one animation.

    Channels are rotations of all joints and the translation of the root; the skin has no mesh, and
    tells programs which nodes are bones.
    """
    count, joints = motion.rotations.shape[:2]
    quaternions = Rotation.from_matrix(motion.rotations.reshape(-1, 3, 3)).as_quat()
    quaternions = on_one_side(quaternions.reshape(count, joints, 4))
    root = motion.parents.index(-1)
    rest = np.zeros((joints, 3))
    for joint, above in enumerate(motion.parents):
        rest[joint] = motion.offsets[joint] + (rest[above] if above >= 0 else 0)
    inverse = np.tile(np.eye(4), (joints, 1, 1))
    inverse[:, :3, 3] = -rest
    times = np.arange(count)[:, None] / motion.rate_hz
    # Matrices of glTF are columns after columns.
    arrays = [(times, "SCALAR"), (motion.root, "VEC3"), (inverse.swapaxes(1, 2), "MAT4")]
    arrays += [(quaternions[:, joint], "VEC4") for joint in range(joints)]
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    content = b""
    for values, shape in arrays:
        data = np.ascontiguousarray(values, dtype="<f4")
        views.append({"buffer": 0, "byteOffset": len(content), "byteLength": data.nbytes})
        accessor = {"bufferView": len(accessors), "componentType": _FLOAT, "count": len(data)}
        accessors.append({**accessor, "type": shape})
        content += data.tobytes()
    accessors[0] |= {"min": [0.0], "max": [float(np.float32(times[-1, 0]))]}
    nodes: list[dict[str, Any]] = [
        {"name": motion.names[joint], "translation": motion.offsets[joint].tolist()}
        for joint in range(joints)
    ]
    for joint, above in enumerate(motion.parents):
        if above >= 0:
            nodes[above].setdefault("children", []).append(joint)
    channels = [{"sampler": 0, "target": {"node": root, "path": "translation"}}]
    channels += [
        {"sampler": 1 + joint, "target": {"node": joint, "path": "rotation"}}
        for joint in range(joints)
    ]
    samplers = [{"input": 0, "output": 1}] + [{"input": 0, "output": 3 + j} for j in range(joints)]
    document = {
        "asset": {"version": "2.0", "generator": "evsplat", "extras": dict(extras or {})},
        "scene": 0,
        "scenes": [{"nodes": [root]}],
        "nodes": nodes,
        "skins": [{"joints": list(range(joints)), "skeleton": root, "inverseBindMatrices": 2}],
        "animations": [{"name": name, "channels": channels, "samplers": samplers}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(content)}],
    }
    write_bytes(path, glb_bytes(document, content))
