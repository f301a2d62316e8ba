"""What each format holds, read back by readers that are not ours or were written apart from it."""

import numpy as np
import pytest

from evsplat.errors import DataError
from evsplat.export.formats import write_gltf, write_ply, write_splat, write_spz

from .clouds import SH_C0, covariances, random_cloud, read_ply, read_spz

SEEDS = pytest.mark.parametrize("seed", [0, 1, 2])


@SEEDS
def test_ply_holds_everything_in_the_layout_of_3dgs(tmp_path, seed):
    cloud = random_cloud(np.random.default_rng(seed), 40)
    cloud.opacities[:2] = 0, 1
    write_ply(tmp_path / "a.ply", cloud, comments=["unit: metre"])
    comments, columns = read_ply(tmp_path / "a.ply")
    assert comments == ["unit: metre"]
    # The order in which graphdeco's scene/gaussian_model.py writes them; viewers rely on it.
    assert list(columns) == [
        *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
        *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
        *("semantic", "seen"),
    ]

    def stack(prefix: str, count: int) -> np.ndarray:
        return np.stack([columns[f"{prefix}_{k}"] for k in range(count)], axis=1)

    np.testing.assert_array_equal(np.stack([columns[a] for a in "xyz"], 1), cloud.means)
    np.testing.assert_array_equal(stack("rot", 4), cloud.quaternions)
    np.testing.assert_allclose(np.exp(stack("scale", 3)), cloud.scales, rtol=1e-6)
    np.testing.assert_allclose(0.5 + SH_C0 * stack("f_dc", 3), cloud.rgb, atol=1e-6)
    opacity = 1 / (1 + np.exp(-columns["opacity"].astype(np.float64)))
    np.testing.assert_allclose(opacity, cloud.opacities, atol=2e-6)
    np.testing.assert_array_equal(columns["semantic"], cloud.semantic)
    np.testing.assert_array_equal(columns["seen"], cloud.seen)
    assert not any(columns[name].any() for name in ("nx", "ny", "nz"))


@SEEDS
@pytest.mark.parametrize(("reach", "bits"), [(7.9, 20), (8.1, 19), (3000.0, 11)])
def test_spz_is_as_precise_as_it_says(tmp_path, seed, reach, bits):
    cloud = random_cloud(np.random.default_rng(seed), 60)
    cloud.means[:] *= reach / np.abs(cloud.means).max()
    write_spz(tmp_path / "a.spz", cloud)
    read = read_spz(tmp_path / "a.spz")
    assert np.abs(read["mean"] - cloud.means).max() <= 0.5 / 2**bits * 1.001
    assert np.abs(read["opacity"] - cloud.opacities).max() <= 0.5 / 255 * 1.001
    step = SH_C0 / 0.15 / 255
    assert np.abs(read["rgb"] - cloud.rgb).max() <= step / 2 * 1.001
    np.testing.assert_allclose(np.log(read["scale"]), np.log(cloud.scales), atol=1 / 32 + 1e-5)
    cosine = np.abs((read["quaternion"] * cloud.quaternions).sum(1)).clip(max=1)
    assert np.degrees(2 * np.arccos(cosine)).max() < 0.25


def test_spz_says_when_gaussians_are_too_far_away(tmp_path):
    cloud = random_cloud(np.random.default_rng(0), 3)
    cloud.means[1, 2] = 1e7
    with pytest.raises(DataError, match="--parts human"):
        write_spz(tmp_path / "a.spz", cloud)
    assert not list(tmp_path.iterdir())


@SEEDS
def test_splat_is_32_bytes_each_with_the_weightiest_first(tmp_path, seed):
    cloud = random_cloud(np.random.default_rng(seed), 50)
    write_splat(tmp_path / "a.splat", cloud)
    data = (tmp_path / "a.splat").read_bytes()
    assert len(data) == 32 * 50
    floats = np.frombuffer(data, "<f4").reshape(50, 8)
    octets = np.frombuffer(data, "u1").reshape(50, 32)
    weight = cloud.opacities * np.prod(cloud.scales, axis=1, dtype=np.float64)
    order = np.argsort(-weight)
    np.testing.assert_array_equal(floats[:, :3], cloud.means[order])
    np.testing.assert_array_equal(floats[:, 3:6], cloud.scales[order])
    rgba = np.column_stack([cloud.rgb.clip(0, 1), cloud.opacities])[order]
    assert np.abs(octets[:, 24:28] / 255 - rgba).max() <= 0.5 / 255 + 1e-6
    quaternions = (octets[:, 28:].astype(float) - 128) / 128
    assert np.abs(quaternions - cloud.quaternions[order]).max() <= 1.001 / 128


@SEEDS
def test_gltf_is_read_by_pygltflib(tmp_path, seed):
    pygltflib = pytest.importorskip("pygltflib", reason="needs the extra dev")
    cloud = random_cloud(np.random.default_rng(seed), 33)
    cloud.rgb[0] = -0.1, 0.5, 1.2
    write_gltf(tmp_path / "a.glb", cloud, extras={"unit": "metre"})
    document = pygltflib.GLTF2().load(str(tmp_path / "a.glb"))
    assert document.extensionsUsed == ["KHR_gaussian_splatting"]
    assert not document.extensionsRequired
    assert document.asset.extras == {"unit": "metre"}
    (primitive,) = document.meshes[0].primitives
    assert primitive.mode == pygltflib.POINTS
    extension = primitive.extensions["KHR_gaussian_splatting"]
    assert (extension["kernel"], extension["colorSpace"]) == ("ellipse", "srgb_rec709_display")
    sizes = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}

    def attribute(name: str) -> np.ndarray:
        accessor = document.accessors[getattr(primitive.attributes, name)]
        view = document.bufferViews[accessor.bufferView]
        assert accessor.componentType == pygltflib.FLOAT and view.byteOffset % 4 == 0
        data = document.binary_blob()[view.byteOffset : view.byteOffset + view.byteLength]
        return np.frombuffer(data, "<f4").reshape(accessor.count, sizes[accessor.type])

    splatting = "KHR_gaussian_splatting:"
    np.testing.assert_array_equal(attribute("POSITION"), cloud.means)
    bounds = document.accessors[primitive.attributes.POSITION]
    np.testing.assert_array_equal(np.float32(bounds.min), cloud.means.min(0))
    np.testing.assert_array_equal(np.float32(bounds.max), cloud.means.max(0))
    xyzw = attribute(splatting + "ROTATION")
    got = covariances(xyzw[:, [3, 0, 1, 2]], attribute(splatting + "SCALE"))
    want = covariances(cloud.quaternions, cloud.scales)
    np.testing.assert_allclose(got, want, atol=1e-7)
    np.testing.assert_array_equal(attribute(splatting + "OPACITY")[:, 0], cloud.opacities)
    harmonics = attribute(splatting + "SH_DEGREE_0_COEF_0")
    np.testing.assert_allclose(0.5 + SH_C0 * harmonics, cloud.rgb, atol=1e-6)
    np.testing.assert_array_equal(attribute("_SEMANTIC")[:, 0], cloud.semantic)
    colour = attribute("COLOR_0")
    assert colour.shape == (33, 4) and colour.min() >= 0 and colour.max() <= 1
    # Known values of the sRGB curve.
    np.testing.assert_allclose(colour[0, :3], [0.0, 0.21404, 1.0], atol=1e-5)
