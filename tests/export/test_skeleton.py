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


def _read_bvh(text: str, *, added: bool) -> tuple[list[str], np.ndarray, float]:
    """Names, joints (T, J, 3) and seconds per key, by the words of the format's description.

    Channels turn about the named axes in the order in which they stand, each one after those
    before it in the joint's own axes; positions of a joint are ``added`` to its offset, as the
    format's description has it and three.js does, or take its place, as Blender does.
    """
    words = text.split()
    hierarchy, motion = words[: words.index("MOTION")], words[words.index("MOTION") + 1 :]
    names, parents, offsets, channels, open_joints = [], [], [], [], []
    joint = None
    for place, word in enumerate(hierarchy):
        if word in ("ROOT", "JOINT"):
            names.append(hierarchy[place + 1])
            parents.append(open_joints[-1] if open_joints else None)
            joint = len(names) - 1
        elif word == "End":
            joint = None
        elif word == "{":
            open_joints.append(joint)
        elif word == "}":
            open_joints.pop()
        elif word == "OFFSET" and joint is not None:
            offsets.append([float(value) for value in hierarchy[place + 1 : place + 4]])
        elif word == "CHANNELS":
            count = int(hierarchy[place + 1])
            channels.append(hierarchy[place + 2 : place + 2 + count])
    count, seconds = int(motion[motion.index("Frames:") + 1]), float(motion[4])
    rows = np.array(motion[5:], dtype=np.float64).reshape(count, -1)
    world = np.tile(np.eye(4), (count, len(names), 1, 1))
    column = 0
    for joint, above in enumerate(parents):
        local = np.tile(np.eye(4), (count, 1, 1))
        local[:, :3, 3] = offsets[joint]
        for channel in channels[joint]:
            axis = "XYZ".index(channel[0])
            if channel.endswith("position"):
                local[:, axis, 3] = rows[:, column] + added * local[:, axis, 3]
            else:
                angle = rows[:, column : column + 1]
                turn = Rotation.from_euler(channel[0].lower(), angle, degrees=True)
                local[:, :3, :3] = local[:, :3, :3] @ turn.as_matrix()
            column += 1
        world[:, joint] = local if above is None else world[:, above] @ local
    assert column == rows.shape[1]
    return names, world[..., :3, 3], seconds


@pytest.mark.parametrize("added", [True, False])
def test_a_reader_by_the_formats_words_reads_the_bvh(run, added):
    path = export_run(run.path, "bvh")
    names, joints, seconds = _read_bvh(path.read_text(encoding="ascii"), added=added)
    body = run.reconstruction.track.body
    order = [names.index("_".join(name.split())) for name in body.joint_names]
    np.testing.assert_allclose(joints[:, order], _joints(run), atol=1e-5)
    assert seconds == pytest.approx(1 / 60, abs=1e-7)


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
