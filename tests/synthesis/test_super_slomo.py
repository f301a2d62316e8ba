"""Super SloMo: the public checkpoint's keys and shapes, and what the networks' outputs mean."""

import json

import numpy as np
import pytest
import torch
from torch.nn import functional as F

from evsplat.capture import load_capture
from evsplat.errors import WeightsError
from evsplat.pictures.files import read_image, write_image
from evsplat.pictures.light import decode, encode
from evsplat.synthesis import super_slomo, synthesize
from evsplat.synthesis.interpolate import Picture
from evsplat.synthesis.super_slomo import SuperSloMo, UNet, backward_warp
from evsplat.weights import MissingWeights

from .helpers import picture, psnr, shifted, texture

PARAMETERS = 39_610_473
"""39.61 million, as published; 151.1 MiB of float32, the size of the public checkpoint."""
DOWN = {"down1": (32, 64, 5), "down2": (64, 128, 3), "down3": (128, 256, 3)}
DOWN |= {"down4": (256, 512, 3), "down5": (512, 512, 3)}
UP = {"up1": (512, 512), "up2": (512, 256), "up3": (256, 128), "up4": (128, 64), "up5": (64, 32)}


def published_shapes(inputs: int, outputs: int) -> dict[str, tuple[int, ...]]:
    """Convolutions of one network as the public code names them."""
    convolutions = {"conv1": (32, inputs, 7), "conv2": (32, 32, 7), "conv3": (outputs, 32, 3)}
    for name, (before, after, size) in DOWN.items():
        convolutions |= {f"{name}.conv1": (after, before, size)}
        convolutions |= {f"{name}.conv2": (after, after, size)}
    for name, (before, after) in UP.items():
        convolutions |= {f"{name}.conv1": (after, before, 3)}
        convolutions |= {f"{name}.conv2": (after, 2 * after, 3)}
    shapes: dict[str, tuple[int, ...]] = {}
    for name, (after, before, size) in convolutions.items():
        shapes |= {f"{name}.weight": (after, before, size, size), f"{name}.bias": (after,)}
    return shapes


def zeros(inputs: int, outputs: int) -> dict[str, torch.Tensor]:
    # one stored number each, so that made-up files stay small
    zero = torch.zeros(1)
    return {name: zero.expand(shape) for name, shape in published_shapes(inputs, outputs).items()}


def checkpoint(path, *, flow=(0.0, 0.0, 0.0, 0.0), refinement=(0.0,) * 5):
    """A file like the public one whose networks always give these values."""
    networks = {}
    for key, channels, values in (
        ("state_dictFC", (6, 4), flow),
        ("state_dictAT", (20, 5), refinement),
    ):
        state = zeros(*channels)
        # the last layer is a leaky ReLU of slope 0.1
        state["conv3.bias"] = torch.tensor([v if v > 0 else 10 * v for v in values])
        networks[key] = state
    torch.save({"Detail": "made up", "epoch": 0, **networks}, path)
    return path


def test_networks_have_the_published_parameters():
    for channels in ((6, 4), (20, 5)):
        found = {name: tuple(p.shape) for name, p in UNet(*channels).state_dict().items()}
        assert found == published_shapes(*channels)
    count = sum(np.prod(s) for c in ((6, 4), (20, 5)) for s in published_shapes(*c).values())
    assert count == PARAMETERS


def test_network_agrees_with_its_convolutions_written_out():
    """The same graph by functional calls on the named tensors."""
    torch.manual_seed(0)
    network = UNet(6, 4).double().eval()
    p = network.state_dict()
    x = torch.rand(1, 6, 64, 32, dtype=torch.float64)

    def layer(name, value):
        weight = p[f"{name}.weight"]
        value = F.conv2d(value, weight, p[f"{name}.bias"], padding=weight.shape[-1] // 2)
        return torch.where(value > 0, value, 0.1 * value)

    level = layer("conv2", layer("conv1", x))
    kept = []
    for name in DOWN:
        kept.append(level)
        halved = level.unfold(2, 2, 2).unfold(3, 2, 2).mean((-1, -2))
        level = layer(f"{name}.conv2", layer(f"{name}.conv1", halved))
    for name in UP:
        skip = kept.pop()
        doubled = F.interpolate(level, size=skip.shape[-2:], mode="bilinear")
        level = layer(f"{name}.conv2", torch.cat((layer(f"{name}.conv1", doubled), skip), 1))
    with torch.no_grad():
        assert torch.allclose(network(x), layer("conv3", level), atol=1e-12)


def test_warp_reads_where_the_flow_points():
    image = torch.rand(1, 2, 32, 48, dtype=torch.float64)
    flow = torch.zeros(1, 2, 32, 48, dtype=torch.float64)
    flow[:, 0] = 3
    flow[:, 1] = -2
    warped = backward_warp(image, flow)
    # coordinates shrink by (W - 1) / W as in the code that trained the checkpoint
    y, x = 20, 11
    at_x, at_y = (x + 3) * 47 / 48, (y - 2) * 31 / 32
    left, top = int(at_x), int(at_y)
    a, b = at_x - left, at_y - top
    corners = image[0, :, top : top + 2, left : left + 2]
    expected = corners[:, 0] @ torch.tensor([1 - a, a], dtype=torch.float64) * (1 - b)
    expected = expected + corners[:, 1] @ torch.tensor([1 - a, a], dtype=torch.float64) * b
    assert torch.allclose(warped[0, :, y, x], expected)


def rewarped(linear: np.ndarray) -> np.ndarray:
    """What the networks' warp makes of a picture that stands: it shrinks by (W - 1) / W."""
    image = torch.from_numpy(linear).permute(2, 0, 1)[None].float()
    warped = backward_warp(image, torch.zeros(1, 2, *linear.shape[:2]))
    return warped[0].permute(1, 2, 0).numpy()


def test_without_motion_and_evidence_it_blends_by_time(tmp_path):
    images = [texture(64, 96, seed) for seed in (0, 1)]
    network = SuperSloMo("linear", checkpoint(tmp_path / "made_up.ckpt"))
    before, after = (Picture(np.float32(i), np.float32(i)) for i in images)
    made = network.between(before, after, (0.25, 0.5))
    for fraction, between in zip((0.25, 0.5), made, strict=True):
        expected = (1 - fraction) * images[0] + fraction * images[1]
        assert between == pytest.approx(rewarped(expected), abs=1e-5)


def test_constant_flow_moves_the_picture_by_the_fraction(tmp_path):
    motion = np.array([7.0, -4.0])
    image = texture(70, 90, seed=2)
    before, after = picture(image), picture(shifted(image, *motion))
    made_up = checkpoint(tmp_path / "made_up.ckpt", flow=(*motion, *-motion))
    made = SuperSloMo("power", made_up).between(before, after, (0.25, 0.75))
    for fraction, between in zip((0.25, 0.75), made, strict=True):
        # padded to a multiple of 32 as the networks want it
        padded = np.pad(shifted(image, *(fraction * motion)), ((0, 26), (0, 6), (0, 0)))
        truth = rewarped(padded)[12:58, 12:78]
        still = (1 - fraction) * before.linear + fraction * after.linear
        assert psnr(between[12:58, 12:78], truth) > 34
        assert psnr(still[12:58, 12:78], truth) < 26


def test_visibility_takes_all_of_one_picture(tmp_path):
    images = [np.full((32, 32, 1), value, np.float32) for value in (0.2, 0.9)]
    before, after = (Picture(image, image) for image in images)
    for sign, expected in ((1, 0.2), (-1, 0.9)):
        made_up = checkpoint(tmp_path / "made_up.ckpt", refinement=(0, 0, 0, 0, 30.0 * sign))
        made = next(SuperSloMo("linear", made_up).between(before, after, [0.5]))
        assert made.shape == (32, 32, 1)
        assert made[:-1, :-1] == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("transfer", ["power", "srgb", "linear"])
def test_a_standing_picture_stays_as_it_is_whatever_curve_its_camera_states(tmp_path, transfer):
    """Sub-frames that are decoded by another curve than the pictures flicker between them."""
    camera = {"width": 64, "height": 32, "K": [[50, 0, 32], [0, 50, 16], [0, 0, 1]]}
    camera |= {"world_to_camera": np.eye(4).tolist(), "transfer": transfer}
    (tmp_path / "camera.json").write_text(json.dumps(camera))
    (tmp_path / "still").mkdir()
    for index in range(5):
        write_image(tmp_path / "still" / f"{index}.png", np.full((32, 64, 3), 60, np.uint8))
    out = synthesize(
        tmp_path / "still",
        tmp_path / "out",
        source_fps=100,
        camera=tmp_path / "camera.json",
        interpolation="super-slomo",
        weights=checkpoint(tmp_path / "made_up.ckpt"),
        upsample=3,
        progress=False,
    )
    capture = load_capture(out)
    for frame in capture.frames:
        # the networks' warp makes the last row and column dark
        assert (read_image(frame.image)[:-1, :-1] == 60).all()
    assert capture.events is not None
    seen = capture.events.between(*capture.events.time_range_us)
    assert not ((seen.x < 63) & (seen.y < 31)).any()


def test_light_stored_as_it_stands_is_looked_at_as_if_it_were_coded(tmp_path, rng):
    """Two cameras record one scene, as light and by the curve of sRGB: the same comes of both."""
    image, made = 0.3 * texture(32, 64, int(rng.integers(1000))), {}
    for transfer in ("srgb", "linear"):
        folder = tmp_path / transfer
        folder.mkdir()
        camera = {"width": 64, "height": 32, "K": [[50, 0, 32], [0, 50, 16], [0, 0, 1]]}
        camera |= {"world_to_camera": np.eye(4).tolist(), "transfer": transfer}
        (tmp_path / "camera.json").write_text(json.dumps(camera))
        for index in range(5):
            light = torch.from_numpy(shifted(image, 3.0 * index, 0).clip(0, 1))
            values = encode(light, transfer).numpy()
            write_image(folder / f"{index}.png", (values * 65535 + 0.5).astype(np.uint16))
        out = synthesize(
            folder,
            tmp_path / f"{transfer}_out",
            source_fps=100,
            camera=tmp_path / "camera.json",
            interpolation="super-slomo",
            weights=checkpoint(tmp_path / "made_up.ckpt"),
            events="none",
            upsample=3,
            progress=False,
        )
        stored = [read_image(frame.image) / 65535 for frame in load_capture(out).frames]
        made[transfer] = decode(torch.from_numpy(np.stack(stored)), transfer).numpy()
    assert made["linear"] == pytest.approx(made["srgb"], abs=1e-4)


def test_missing_weights_say_what_and_where(tmp_path, monkeypatch):
    monkeypatch.delenv(super_slomo.CHECKPOINT.variable, raising=False)
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path / "hub"))
    with pytest.raises(MissingWeights) as error:
        SuperSloMo("power")
    for words in ("SuperSloMo.ckpt (151 MB)", "avinashpaliwal/Super-SloMo", "hub", "--weights"):
        assert words in str(error.value)
    monkeypatch.setenv(super_slomo.CHECKPOINT.variable, str(tmp_path / "named.ckpt"))
    with pytest.raises(MissingWeights, match=r"named\.ckpt"):
        SuperSloMo("power")


def test_other_files_are_no_checkpoint(tmp_path):
    path = tmp_path / "other.ckpt"
    torch.save({"state_dictFC": zeros(6, 4)}, path)
    with pytest.raises(WeightsError, match="state_dictAT"):
        SuperSloMo("power", path)
    # v2e's checkpoint of grey pictures has other inputs
    torch.save({"state_dictFC": zeros(2, 4), "state_dictAT": zeros(12, 5)}, path)
    with pytest.raises(WeightsError, match=r"conv1.weight: expected \(32, 6, 7, 7\)"):
        SuperSloMo("power", path)
    torch.save({"state_dictFC": {0: torch.zeros(2), "step": 3}, "state_dictAT": {}}, path)
    with pytest.raises(WeightsError, match="state_dictFC.conv1.bias: expected"):
        SuperSloMo("power", path)
    path.write_bytes(b"not a checkpoint")
    with pytest.raises(WeightsError, match="not a readable PyTorch weight file"):
        SuperSloMo("power", path)


def test_a_checkpoint_that_would_run_code_is_refused(tmp_path):
    class Harmful:
        def __reduce__(self):
            return (open, (str(tmp_path / "ran"), "w"))

    torch.save({"state_dictFC": Harmful()}, tmp_path / "harmful.ckpt")
    with pytest.raises(WeightsError, match=r"harmful\.ckpt"):
        SuperSloMo("power", tmp_path / "harmful.ckpt")
    assert not (tmp_path / "ran").exists()
