"""The SMPL family on made-up files of the right shape: random arrays, no licensed data."""

import io
import pickle
import sys
import types
import zipfile

import numpy as np
import pytest
import torch
from body_models.smpl.torch import SMPL
from scipy import sparse

from evsplat.body import axis_angle_to_matrix, skin
from evsplat.body.canonical import SMPL_PARENTS
from evsplat.body.smpl import ENVIRONMENT, find_model_file, read_model_file, smpl_body
from evsplat.errors import DataError, WeightsError

VERTICES = 40


def smpl_like(seed=0, joints=24, directions=10, parents=SMPL_PARENTS):
    rng = np.random.default_rng(seed)
    weights = rng.random((VERTICES, joints)) ** 6
    regressor = rng.random((joints, VERTICES)) ** 8
    tree = np.array([parents, range(joints)]).astype(np.uint32)  # the root as 2^32 - 1
    return {
        "v_template": rng.normal(size=(VERTICES, 3)),
        "f": rng.integers(0, VERTICES, (70, 3)).astype(np.uint32),
        "weights": weights / weights.sum(1, keepdims=True),
        "shapedirs": 0.1 * rng.normal(size=(VERTICES, 3, directions)),
        "posedirs": np.zeros((VERTICES, 3, 9 * (joints - 1))),
        "J_regressor": regressor / regressor.sum(1, keepdims=True),
        "kintree_table": tree,
    }


@pytest.mark.parametrize("seed", range(3))
def test_posed_vertices_equal_those_of_body_models(tmp_path, seed):
    file = tmp_path / "SMPL_NEUTRAL.npz"
    np.savez(file, **smpl_like(seed))
    rng = np.random.default_rng(seed)
    betas, poses, transl = rng.normal(size=10), rng.normal(size=(3, 24, 3)), rng.normal(size=(3, 3))
    body = smpl_body("smpl", betas, path=tmp_path)
    assert body.joint_names[1] == "left_hip"
    rotations = axis_angle_to_matrix(torch.tensor(poses)).float()
    bones = body.bone_transforms(rotations, torch.tensor(transl).float())
    moved, _ = skin(body.rest_vertices, body.weights, bones)

    model = SMPL(model_path=file)
    expected = model.forward_vertices(
        torch.tensor(poses[:, 1:]).float(),
        pelvis_rotation=torch.tensor(poses[:, 0]).float(),
        shape=torch.tensor(betas).float().expand(3, -1),
        global_translation=torch.tensor(transl).float(),
    )
    assert (moved - expected).abs().max() < 1e-5
    identity = model.prepare_identity(torch.tensor(betas).float()[None])
    pose = model.prepare_pose(
        torch.tensor(poses[:, 1:]).float(),
        pelvis_rotation=torch.tensor(poses[:, 0]).float(),
        identity=identity,
    )
    still = body.bone_transforms(rotations, torch.zeros(3, 3))
    assert (still - pose["skinning_transforms"]).abs().max() < 1e-5


def test_canonical_smpl_has_its_legs_45_degrees_apart(tmp_path):
    np.savez(tmp_path / "SMPL_MALE.npz", **smpl_like())
    body = smpl_body("smpl", gender="male", path=tmp_path)
    turns = body.canonical_bone_transforms()[:, :3, :3]
    angle = torch.rad2deg(torch.acos((turns[1].trace() - 1) / 2))
    assert abs(angle.item() - 45) < 1e-3
    assert torch.allclose(turns[10], turns[1], atol=1e-6)  # the whole chain 1, 4, 7, 10
    assert torch.allclose(turns[15], torch.eye(3), atol=1e-6)


def test_smplx_with_pickled_joint_names_is_read(tmp_path):
    parents = (*SMPL_PARENTS[:22], 15, 15, 15, *np.repeat([20, 21], 15).tolist())
    names = {f"joint{j}": j for j in range(55) if j not in (1, 2)}
    names |= {"left_hip": 1, "right_hip": 2}
    arrays = smpl_like(joints=55, directions=400, parents=parents)
    hands = {"hands_meanl": np.ones(45), "hands_meanr": np.ones(45)}
    (tmp_path / "smplx").mkdir()
    np.savez(
        tmp_path / "smplx" / "SMPLX_NEUTRAL.npz",
        **arrays,
        **hands,
        joint2num=np.array(names, dtype=object),
    )
    betas = np.array([0.3, -0.2, 1.0])
    body = smpl_body("smplx", betas, path=tmp_path)
    expected = arrays["v_template"] + arrays["shapedirs"][:, :, :3] @ betas
    assert np.abs(body.rest_vertices.numpy() - expected).max() < 1e-5
    joints = arrays["J_regressor"] @ expected
    assert np.abs(body.rest_joints.numpy() - joints).max() < 1e-5
    assert body.joint_names[2] == "right_hip" and len(body.parents) == 55


def chumpy_pickle(arrays, path):
    """A file like SMPL's first release: chumpy wrappers and a sparse regressor, protocol 2."""

    class Ch:
        def __init__(self, value):
            self.x = value

    modules = {name: types.ModuleType(name) for name in ("chumpy", "chumpy.ch")}
    modules["chumpy.ch"].Ch = Ch
    Ch.__module__, Ch.__qualname__ = "chumpy.ch", "Ch"
    sys.modules.update(modules)
    try:
        wrapped = {**arrays, "shapedirs": Ch(arrays["shapedirs"]), "extra": "kept out"}
        wrapped["J_regressor"] = sparse.csc_matrix(arrays["J_regressor"])
        path.write_bytes(pickle.dumps(wrapped, protocol=2))
    finally:
        for name in modules:
            del sys.modules[name]


def test_chumpy_and_sparse_pickles_give_the_same_body(tmp_path):
    arrays = smpl_like(5)
    chumpy_pickle(arrays, tmp_path / "SMPL_NEUTRAL.pkl")
    read = read_model_file(tmp_path / "SMPL_NEUTRAL.pkl")
    assert "extra" not in read
    for key in arrays:
        assert np.allclose(read[key], arrays[key]), key
    (tmp_path / "npz").mkdir()
    np.savez(tmp_path / "npz" / "SMPL_NEUTRAL.npz", **arrays)
    one = smpl_body("smpl", path=tmp_path)
    other = smpl_body("smpl", path=tmp_path / "npz")
    assert torch.allclose(one.rest_joints, other.rest_joints)
    assert torch.equal(one.weights, other.weights)


class Attack:
    def __reduce__(self):
        return (open, ("touched", "w"))


@pytest.mark.parametrize("kind", ["pkl", "npz"])
def test_a_file_with_code_in_it_is_refused_and_not_run(tmp_path, monkeypatch, kind):
    monkeypatch.chdir(tmp_path)
    file = tmp_path / f"SMPL_NEUTRAL.{kind}"
    if kind == "pkl":
        file.write_bytes(pickle.dumps({**smpl_like(), "v_template": Attack()}))
    else:
        np.savez(file, **smpl_like(), joint2num=np.array(Attack(), dtype=object))
    with pytest.raises(DataError, match=r"pickled type (_io|io)\.open.*was not loaded"):
        read_model_file(file)
    assert not (tmp_path / "touched").exists()


def test_missing_folder_file_and_package_say_what_to_get_and_where(tmp_path, monkeypatch):
    monkeypatch.delenv(ENVIRONMENT, raising=False)
    with pytest.raises(WeightsError, match=r"SMPL \(neutral\).*smpl\.is\.tue.*EVSPLAT_BODY_MODELS"):
        smpl_body("smpl")
    monkeypatch.setenv(ENVIRONMENT, str(tmp_path))
    with pytest.raises(WeightsError, match=r"put it at .*smplx/SMPLX_FEMALE\.npz"):
        smpl_body("smplx", gender="female")
    (tmp_path / "SMPL_NEUTRAL.npz").write_bytes(b"")
    monkeypatch.setitem(sys.modules, "body_models", None)
    monkeypatch.setitem(sys.modules, "body_models.smpl.torch", None)
    with pytest.raises(WeightsError, match=r"pip install 'evsplat\[body-models\]'"):
        smpl_body("smpl")
    with pytest.raises(DataError, match="gender is 'x'"):
        find_model_file("smpl", "x", tmp_path)


def test_broken_files_are_one_sentence(tmp_path):
    file = tmp_path / "SMPL_NEUTRAL.npz"
    np.savez(file, **smpl_like())
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(DataError, match="not a readable body model"):
        smpl_body("smpl", path=file)
    with zipfile.ZipFile(file, "w") as archive:
        stream = io.BytesIO()
        np.save(stream, np.zeros(3))
        archive.writestr("something.npy", stream.getvalue())
    with pytest.raises(DataError, match="not a SMPL model, v_template, shapedirs, J_regressor"):
        smpl_body("smpl", path=file)
    (tmp_path / "x.pkl").write_bytes(pickle.dumps([1, 2]))
    with pytest.raises(DataError, match="holds a list, expected a dict"):
        smpl_body("smpl", path=tmp_path / "x.pkl")
