import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from evsplat.body.motion import load_motion
from evsplat.errors import DataError

# x left, y up, z forward: a person of sticks, lengths in inches
OFFSETS = {
    "root": (None, (0, 0, 0)),
    "lfemur": ("root", (4, -2, 0)),
    "ltibia": ("lfemur", (2, -16, 0)),
    "lfoot": ("ltibia", (2, -16, 1)),
    "rfemur": ("root", (-4, -2, 0)),
    "rtibia": ("rfemur", (-2, -16, 0)),
    "rfoot": ("rtibia", (-2, -16, 1)),
    "thorax": ("root", (0, 12, 0)),
    "head": ("thorax", (0, 10, 0)),
    "lhumerus": ("thorax", (7, 5, 0)),
    "lradius": ("lhumerus", (10, -4, 0)),
    "lhand": ("lradius", (9, -3, 1)),
    "rhumerus": ("thorax", (-7, 5, 0)),
    "rradius": ("rhumerus", (-10, -4, 0)),
    "rhand": ("rradius", (-9, -3, 1)),
}
NAMES = list(OFFSETS)
PARENTS = [-1 if OFFSETS[n][0] is None else NAMES.index(OFFSETS[n][0]) for n in NAMES]


def joints(rotations: np.ndarray, root: np.ndarray, offsets: list) -> np.ndarray:
    """Forward kinematics (T, J, 3) from rotations relative to the parent, one joint at a time."""
    world, places = {}, {}
    for j, parent in enumerate(PARENTS):
        if parent < 0:
            world[j], places[j] = rotations[:, j], root
        else:
            world[j] = world[parent] @ rotations[:, j]
            places[j] = places[parent] + world[parent] @ offsets[j]
    return np.stack([places[j] for j in range(len(PARENTS))], 1)


def bvh_text(angles: np.ndarray, root: np.ndarray, order: str) -> str:
    def joint(name: str, depth: int) -> list[str]:
        pad = "  " * depth
        word = "ROOT" if depth == 0 else "JOINT"
        turns = " ".join(f"{axis.upper()}rotation" for axis in order)
        moves = "Xposition Yposition Zposition " if depth == 0 else ""
        below = [child for child in NAMES if OFFSETS[child][0] == name]
        lines = [f"{pad}{word} {name}", pad + "{"]
        lines.append(f"{pad}  OFFSET {' '.join(map(str, OFFSETS[name][1]))}")
        lines.append(f"{pad}  CHANNELS {6 if depth == 0 else 3} {moves}{turns}")
        for child in below:
            lines += joint(child, depth + 1)
        if not below:
            lines += [f"{pad}  End Site", pad + "  {", f"{pad}    OFFSET 0 1 0", pad + "  }"]
        return [*lines, pad + "}"]

    depth_first: list[str] = []

    def visit(name: str) -> None:
        depth_first.append(name)
        for child in NAMES:
            if OFFSETS[child][0] == name:
                visit(child)

    visit("root")
    rows = []
    for t in range(len(angles)):
        numbers = [*root[t]]
        for name in depth_first:
            numbers += angles[t, NAMES.index(name)].tolist()
        rows.append(" ".join(f"{number:.9f}" for number in numbers))
    head = ["HIERARCHY", *joint("root", 0), "MOTION", f"Frames: {len(angles)}"]
    return "\n".join([*head, "Frame Time: 0.0125", *rows])


def random_motion(seed: int, count: int = 5) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.uniform(-70, 70, (count, len(NAMES), 3)), rng.normal(size=(count, 3)) * 20


@pytest.mark.parametrize("order", ["zxy", "xyz"])
def test_bvh_gives_the_joints_of_its_angles(tmp_path, order):
    angles, root = random_motion(0)
    (tmp_path / "a.bvh").write_text(bvh_text(angles, root, order))
    motion = load_motion(tmp_path / "a.bvh")
    # channels turn about axes that move along: the last channel is applied first
    local = Rotation.from_euler(order.upper(), angles.reshape(-1, 3), degrees=True).as_matrix()
    offsets = [np.array(OFFSETS[name][1], float) for name in NAMES]
    expected = joints(local.reshape(5, -1, 3, 3), root, offsets)
    order_of = [motion.joint_names.index(name) for name in NAMES]
    to_world = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])  # z up, facing -y
    assert np.abs(motion.joints()[:, order_of] - expected @ to_world.T).max() < 1e-6
    assert motion.times_us.tolist() == [0, 12500, 25000, 37500, 50000]


def acclaim_files(tmp_path, angles: np.ndarray, root: np.ndarray, axes: np.ndarray) -> None:
    """Each bone begins at its joint and ends at its first child, as Acclaim draws skeletons."""
    lines = [":version 1.10", ":units", "  length 0.45", "  angle deg", ":root", ":bonedata"]
    for j, name in enumerate(NAMES[1:], start=1):
        children = [c for c in range(len(NAMES)) if PARENTS[c] == j]
        bone = np.array(OFFSETS[NAMES[children[0]]][1] if children else (0, 1, 0), float)
        length = np.linalg.norm(bone)
        direction = " ".join(f"{x:.12f}" for x in bone / length)
        lines += ["begin", f"  name {name}", f"  direction {direction}", f"  length {length:.12f}"]
        lines += [f"  axis {' '.join(f'{x:.9f}' for x in axes[j])} XYZ", "  dof rx ry rz", "end"]
    lines += [":hierarchy", "begin"]
    for j, name in enumerate(NAMES):
        below = [NAMES[c] for c in range(len(NAMES)) if PARENTS[c] == j]
        lines += [" ".join([name, *below])] if below else []
    (tmp_path / "07.asf").write_text("\n".join([*lines, "end"]))
    rows = [":FULLY-SPECIFIED", ":DEGREES"]
    for t in range(len(angles)):
        rows.append(str(t + 1))
        for j, name in enumerate(NAMES):
            numbers = [*root[t], *angles[t, j]] if j == 0 else angles[t, j]
            rows.append(f"{name} {' '.join(f'{x:.9f}' for x in numbers)}")
    (tmp_path / "07_01.amc").write_text("\n".join(rows))


def test_acclaim_gives_the_joints_of_its_angles(tmp_path):
    angles, root = random_motion(1)
    axes = np.random.default_rng(2).uniform(-60, 60, (len(NAMES), 3))
    acclaim_files(tmp_path, angles, root, axes)
    motion = load_motion(tmp_path / "07_01.amc")
    # fixed axes x, y, z in that order, in the bone's own frame
    turn = Rotation.from_euler("xyz", angles.reshape(-1, 3), degrees=True).as_matrix()
    turn = turn.reshape(5, -1, 3, 3)
    frame = Rotation.from_euler("xyz", axes, degrees=True).as_matrix()
    local = frame @ turn @ frame.transpose(0, 2, 1)
    local[:, 0] = turn[:, 0]
    # a bone begins where the one above ends: siblings begin at one place
    offsets = [np.zeros(3)] * len(NAMES)
    for j, parent in enumerate(PARENTS):
        if parent > 0:
            first = [c for c in range(len(NAMES)) if PARENTS[c] == parent][0]
            offsets[j] = np.array(OFFSETS[NAMES[first]][1], float)
    to_world = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    expected = joints(local, root, offsets) @ to_world.T * 0.0254 / 0.45
    order_of = [motion.joint_names.index(name) for name in NAMES]
    assert np.abs(motion.joints()[:, order_of] - expected).max() < 1e-6
    assert np.abs(np.diff(motion.times_us) - 1e6 / 120).max() <= 1


@pytest.mark.parametrize("told", ["skeleton", "motion", "both"])
def test_acclaim_angles_may_be_radians(tmp_path, told):
    angles, root = random_motion(4)
    axes = np.random.default_rng(5).uniform(-60, 60, (len(NAMES), 3))
    acclaim_files(tmp_path, angles, root, axes)
    expected = load_motion(tmp_path / "07_01.amc").joints()
    of_skeleton = np.radians(axes) if told != "motion" else axes
    acclaim_files(tmp_path, np.radians(angles), root, of_skeleton)
    skeleton, motion = tmp_path / "07.asf", tmp_path / "07_01.amc"
    said = "" if told == "skeleton" else ":RADIANS"
    motion.write_text(motion.read_text().replace(":DEGREES", said))
    if told != "motion":
        skeleton.write_text(skeleton.read_text().replace("angle deg", "angle rad"))
    np.testing.assert_allclose(load_motion(motion).joints(), expected, atol=1e-6)


@pytest.mark.parametrize(
    ("given", "other"),
    [
        (":root", ":root\n  order TX TY TZ RZ RY RX"),
        (":root", ":root\n  order RX RY RZ TX TY TZ"),
        (":root", ":root\n  axis ZYX"),
        (" XYZ", " ZYX"),
    ],
)
def test_acclaim_turns_in_another_order_are_refused(tmp_path, given, other):
    acclaim_files(tmp_path, *random_motion(6), np.zeros((len(NAMES), 3)))
    skeleton = tmp_path / "07.asf"
    usual = ":root\n  order TX TY TZ RX RY RZ\n  axis XYZ"
    skeleton.write_text(skeleton.read_text().replace(":root", usual))
    load_motion(tmp_path / "07_01.amc")
    skeleton.write_text(skeleton.read_text().replace(usual, ":root").replace(given, other, 1))
    with pytest.raises(DataError, match=r"07\.asf: line \d+ cannot be read \(the order .*expected"):
        load_motion(tmp_path / "07_01.amc")


def deepmimic_frames(count: int = 3) -> np.ndarray:
    frames = np.zeros((count, 44))
    frames[:, 0] = 0.0333
    frames[:, 2] = 0.9
    for start in (4, 8, 12, 16, 21, 25, 30, 35, 39):
        frames[:, start] = 1
    return frames


def write_deepmimic(path, frames: np.ndarray) -> None:
    path.write_text(json.dumps({"Loop": "wrap", "Frames": frames.tolist()}))


def test_deepmimic_joints_by_hand(tmp_path):
    frames = deepmimic_frames()
    frames[1, 20] = -np.pi / 2  # right knee bends: the shin points back
    frames[2, 4:8] = np.cos(np.pi / 4), 0, np.sin(np.pi / 4), 0  # a quarter turn to the left
    write_deepmimic(tmp_path / "m.txt", frames)
    motion = load_motion(tmp_path / "m.txt")
    places = motion.joints()
    names = motion.joint_names
    right_foot, right_hip = names.index("right_ankle"), names.index("right_hip")
    # world: z up, facing -y, so the right is at -x
    assert places[0, right_hip] == pytest.approx([-0.084887, 0, 0.9])
    assert places[0, right_foot] == pytest.approx([-0.084887, 0, 0.9 - 0.421546 - 0.40987])
    assert places[1, right_foot] == pytest.approx([-0.084887, 0.40987, 0.9 - 0.421546])
    # facing +x now, the right is at -y
    assert places[2, right_hip] == pytest.approx([0, -0.084887, 0.9])
    assert motion.times_us.tolist() == [0, 33300, 66600]


def bvh_of(channels: str, frames: str = "1") -> str:
    head = f"HIERARCHY ROOT a {{ OFFSET 0 0 0 CHANNELS {len(channels.split())} {channels} }}"
    return f"{head} MOTION Frames: {frames} Frame Time: 0.1 " + "0 " * len(channels.split())


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("a.txt", '{"Frames": [[1, 2, 3]]}', "expected (T, 44)"),
        ("a.txt", "{}", "not a DeepMimic motion"),
        ("a.txt", "[" * 100_000, "not a DeepMimic motion (nested too deeply)"),
        ("a.txt", '{"Frames": [[1' + "0" * 400 + "]]}", "not a DeepMimic motion"),
        ("a.bvh", bvh_of("Wrotation"), "a channel 'Wrotation', expected Xposition to Zrotation"),
        ("a.bvh", bvh_of("Wposition"), "a channel 'Wposition'"),
        ("a.bvh", bvh_of(""), "holds no joints, no frames"),
        ("a.bvh", bvh_of("", frames="9" * 30), "not a readable BVH file"),
        ("a.bvh", "HIERARCHY ROOT a { OFFSET 0 0 0 CHANNELS 3 Xrotation", "ends too early"),
        ("a.bvh", "MOTION Frames: 1 Frame Time: 0.1", "holds no joints"),
        ("1_1.amc", "1\nroot 0 0 0 0 0 0", "1.asf is not beside it"),
        ("a.fbx", "", "motion files end in"),
    ],
)
def test_bad_files_are_named_in_one_sentence(tmp_path, name, text, said):
    (tmp_path / name).write_text(text)
    with pytest.raises(DataError) as raised:
        load_motion(tmp_path / name)
    assert said in str(raised.value) and name in str(raised.value)
    assert "\n" not in str(raised.value)


def test_motion_of_another_skeleton_is_refused(tmp_path):
    angles, root = random_motion(3)
    acclaim_files(tmp_path, angles, root, np.zeros((len(NAMES), 3)))
    path = tmp_path / "07_01.amc"
    path.write_text(path.read_text().replace("lhand", "lpaw"))
    with pytest.raises(DataError, match="0 numbers for lhand, expected 3"):
        load_motion(path)


def test_recorded_acclaim_motion_stands_on_the_floor(captures_root):
    motion = load_motion(captures_root.parent / "stage" / "motions" / "cmu" / "02_03.amc")
    places = motion.joints()
    lowest, highest = places[..., 2].min(1), places[..., 2].max(1)
    assert 0 < np.percentile(lowest, 10) < 0.12
    assert 1.4 < np.median(highest) < 1.9
