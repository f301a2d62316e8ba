"""Motion leaves as .bvh and as glTF, and joints are where they were."""

import struct

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from evsplat.body.make import default_body
from evsplat.body.motion import load_motion
from evsplat.errors import ConfigError
from evsplat.export import export_run
from evsplat.export.avatar import clip_of, recorded_clip
from evsplat.export.gaussians import file_rotation, rest_track
from evsplat.export.skeleton import file_motion, write_bvh
from evsplat.film import load_motion_of

pygltflib = pytest.importorskip("pygltflib")


def _placed(body, bones: torch.Tensor, turn: np.ndarray) -> np.ndarray:
    """Joints (T, J, 3) under bone transforms canonical to world, in the axes of the file."""
    placed = bones @ body.canonical_bone_transforms()
    homogeneous = torch.cat([body.rest_joints, torch.ones(len(body.parents), 1)], 1)
    joints = (placed @ homogeneous[..., None])[..., :3, 0].double().numpy()
    return joints @ turn.T


def _joints(run) -> np.ndarray:
    """Recorded joints in the axes of the file, by the body itself."""
    source, mids = run.reconstruction, [frame.mid_us for frame in run.capture.frames]
    clip = recorded_clip(source, (min(mids), max(mids)))
    times = [min(mids) + round(k * 1e6 / clip.rate_hz) for k in range(len(clip.transl))]
    turn = file_rotation(source.track, "gltf", None)
    return _placed(source.track.body, source.pose(times)[1], turn)


def test_our_reader_reads_the_bvh_back(tmp_path):
    """A kick of a whole body: joints by the file against those by the body."""
    track = load_motion_of("kick", rest_track(default_body()))
    clip = clip_of("kick", track)
    turn = file_rotation(track, "gltf", None)
    write_bvh(tmp_path / "kick.bvh", file_motion(clip, track.body, turn))
    motion = load_motion(tmp_path / "kick.bvh")
    order = [motion.joint_names.index(name) for name in track.body.joint_names]
    got = (motion.joints() @ motion.world_from_source)[:, order]
    first = int(track.times_us[0])
    times = [first + round(k * 1e6 / clip.rate_hz) for k in range(len(clip.transl))]
    want = _placed(track.body, track.bones(times), turn)
    np.testing.assert_allclose(got, want, atol=1e-4)
    assert np.abs(np.diff(motion.times_us) - 1e6 / 60).max() < 2


def test_another_reader_reads_the_skeleton_back(run):
    path = export_run(run.path, "skeleton", out=run.path / "moves.glb")
    read = pygltflib.GLTF2().load(str(path))
    data = read.binary_blob()

    def values(number: int) -> np.ndarray:
        accessor = read.accessors[number]
        view = read.bufferViews[accessor.bufferView]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}[accessor.type]
        raw = data[view.byteOffset : view.byteOffset + view.byteLength]
        return np.frombuffer(raw, "<f4").reshape(accessor.count, width)

    (animation,) = read.animations
    keys = len(values(animation.samplers[0].input))
    local = np.tile(np.eye(4), (keys, len(read.nodes), 1, 1))
    for number, node in enumerate(read.nodes):
        local[:, number, :3, 3] = node.translation
    for channel in animation.channels:
        output = values(animation.samplers[channel.sampler].output)
        if channel.target.path == "rotation":
            local[:, channel.target.node, :3, :3] = Rotation.from_quat(output).as_matrix()
        else:
            local[:, channel.target.node, :3, 3] = output
    world = {read.scenes[0].nodes[0]: local[:, read.scenes[0].nodes[0]]}
    waiting = list(world)
    for number in waiting:
        for child in read.nodes[number].children or []:
            world[child] = world[number] @ local[:, child]
            waiting.append(child)
    got = np.stack([world[number][:, :3, 3] for number in range(len(read.nodes))], 1)
    np.testing.assert_allclose(got, _joints(run), atol=1e-4)
    assert read.skins[0].joints == list(range(len(read.nodes)))
    kind, length = struct.unpack_from("<4s4xI", path.read_bytes())
    assert (kind, length) == (b"glTF", path.stat().st_size)


def test_the_recorded_motion_leaves_and_useless_options_are_refused(run):
    path = export_run(run.path, "bvh")
    assert path.name == "recorded.bvh"
    text = path.read_text(encoding="ascii")
    assert text.startswith("HIERARCHY") and f"Frames: {len(_joints(run))}" in text
    with pytest.raises(ConfigError, match="--parts"):
        export_run(run.path, "bvh", parts="human")
    with pytest.raises(ConfigError, match="--canonical"):
        export_run(run.path, "skeleton", canonical=True)
