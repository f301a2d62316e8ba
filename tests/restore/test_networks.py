"""Restorers that load public checkpoints: names, shapes, sizes, inputs; made-up weights."""

import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from evsplat.capture import load_capture
from evsplat.cli import main
from evsplat.errors import DataError, WeightsError
from evsplat.events import EventStream
from evsplat.restore import RESTORERS, WEIGHT_FILES, restore_capture
from evsplat.restore.d2net import D2Net, TwoIterations, event_stack
from evsplat.restore.e2vid import E2Vid, RecurrentUNet
from evsplat.restore.efnet import TwoStages, event_mask, symmetric_cumulative
from evsplat.restore.mprnet import ThreeStages
from evsplat.restore.nafnet import LocalMean, NafUNet
from evsplat.restore.network import in_tiles
from evsplat.restore.pwcnet import PwcNet, _costs, warped
from evsplat.weights import MissingWeights

from ..seen import seen

SMALL_NAFNET = {"width": 4, "down": [1, 1, 1, 2], "middle": 1, "up": [1, 1, 1, 1]}
E2VID_MODEL = {
    "num_bins": 5,
    "skip_type": "sum",
    "recurrent_block_type": "convlstm",
    "num_encoders": 2,
    "base_num_channels": 4,
    "num_residual_blocks": 1,
    "norm": "BN",
    "use_upsample_conv": True,
}


def _nafnet() -> dict:
    return {"params": NafUNet(**SMALL_NAFNET).state_dict()}


def _mprnet() -> dict:
    state = ThreeStages().state_dict()
    return {"epoch": 3, "state_dict": {f"module.{key}": value for key, value in state.items()}}


def _e2vid() -> dict:
    network = RecurrentUNet(levels=2, channels=4, residuals=1)
    state = {f"unetrecurrent.{key}": value for key, value in network.state_dict().items()}
    return {"arch": "E2VIDRecurrent", "model": E2VID_MODEL, "state_dict": state}


CHECKPOINTS: dict[str, Callable[[], dict]] = {
    "nafnet": _nafnet,
    "mprnet": _mprnet,
    "efnet": lambda: {"params": TwoStages().state_dict()},
    "d2net": lambda: dict(TwoIterations().state_dict()),
    "e2vid": _e2vid,
}


def _stream(seed: int, count: int, width: int, height: int, start: int = 0) -> EventStream:
    rng = np.random.default_rng(seed)
    return EventStream(
        t=start + np.sort(rng.integers(0, 40_000, count)),
        x=rng.integers(0, width, count).astype(np.uint16),
        y=rng.integers(0, height, count).astype(np.uint16),
        p=rng.choice(np.array([-1, 1], np.int8), count),
    )


def _part(events: EventStream, first: int, count: int) -> EventStream:
    columns = (events.t, events.x, events.y, events.p)
    return EventStream(*(column[first : first + count] for column in columns))


def _count(network: torch.nn.Module) -> int:
    return sum(value.numel() for value in network.parameters())


def test_sizes_are_the_published_ones() -> None:
    """In millions: NAFNet 17.1 and 67.9, MPRNet 20.1, EFNet 8.47, E2VID 10.71 (their papers)."""
    naf = {"down": [1, 1, 1, 28], "middle": 1, "up": [1, 1, 1, 1]}
    with torch.device("meta"):
        assert _count(NafUNet(32, **naf)) == 17_111_907
        assert _count(NafUNet(64, **naf)) == 67_888_835
        assert _count(ThreeStages()) == 20_127_073
        assert _count(TwoStages()) == 8_466_445
        assert _count(RecurrentUNet(normalised=False)) == 10_710_401
        assert _count(PwcNet()) == 9_374_274
        assert _count(TwoIterations()) == 35_008_810


PUBLISHED = {
    NafUNet: {
        "intro.weight": (4, 3, 3, 3),
        "encoders.3.1.conv2.weight": (64, 1, 3, 3),
        "encoders.0.0.sca.1.bias": (4,),
        "middle_blks.0.norm2.weight": (64,),
        "ups.0.0.weight": (128, 64, 1, 1),
        "downs.2.weight": (32, 16, 2, 2),
        "decoders.3.0.beta": (1, 4, 1, 1),
    },
    ThreeStages: {
        "shallow_feat1.1.CA.conv_du.0.weight": (24, 96, 1, 1),
        "shallow_feat3.1.body.1.weight": (1,),
        "stage1_encoder.encoder_level3.1.body.2.weight": (192, 192, 3, 3),
        "stage2_encoder.csff_dec2.weight": (144, 144, 1, 1),
        "stage2_encoder.down12.down.1.weight": (144, 96, 1, 1),
        "stage1_decoder.up32.up.1.weight": (144, 192, 1, 1),
        "stage3_orsnet.up_enc2.0.up.1.weight": (144, 192, 1, 1),
        "stage3_orsnet.orb2.body.8.weight": (128, 128, 3, 3),
        "concat23.weight": (128, 192, 3, 3),
    },
    TwoStages: {
        "conv_ev1.weight": (64, 6, 3, 3),
        "down_path_1.2.image_event_transformer.attn.temperature": (4, 1, 1),
        "down_path_1.0.image_event_transformer.norm1_event.body.bias": (64,),
        "down_path_1.1.image_event_transformer.ffn.fc1.weight": (512, 128),
        "down_path_2.1.emgc_dec_mask.weight": (128, 128, 3, 3),
        "down_path_ev.2.conv_before_merge.weight": (256, 256, 1, 1),
        "down_path_ev.0.downsample.weight": (64, 64, 4, 4),
        "up_path_2.0.conv_block.identity.weight": (128, 256, 1, 1),
        "sam12.conv3.bias": (64,),
    },
    TwoIterations: {
        "flow_net_nsf.moduleNetwork.moduleExtractor.moduleSix.4.weight": (196, 196, 3, 3),
        "flow_net_near.moduleNetwork.moduleFiv.moduleUpfeat.weight": (529, 2, 4, 4),
        "flow_net_near.moduleNetwork.moduleTwo.moduleOne.0.weight": (128, 117, 3, 3),
        "flow_net_near.moduleNetwork.moduleRefiner.moduleMain.12.bias": (2,),
        "recons_net_near.event_in.0.weight": (32, 40, 3, 3),
        "recons_net_nsf.inBlock.0.0.weight": (32, 9, 5, 5),
        "recons_net_nsf.encoder_second.3.se.fc.2.weight": (128, 32),
        "recons_net_nsf.decoder_first.3.0.weight": (64, 32, 3, 3),
        "recons_net_nsf.midLSTM.conv_ho.weight": (128, 128, 3, 3),
        "recons_net_near.transform1.g.0.weight": (32, 128, 1, 1),
        "recons_net_near.outBlock.3.weight": (3, 32, 5, 5),
    },
    RecurrentUNet: {
        "head.conv2d.bias": (32,),
        "encoders.2.conv.norm_layer.running_var": (256,),
        "encoders.0.recurrent_block.Gates.weight": (256, 128, 3, 3),
        "resblocks.1.bn2.num_batches_tracked": (),
        "decoders.0.conv2d.weight": (128, 256, 5, 5),
        "pred.norm_layer.weight": (1,),
    },
}


@pytest.mark.parametrize("definition", PUBLISHED, ids=lambda definition: definition.__name__)
def test_names_and_shapes_are_the_published_ones(definition) -> None:
    options = SMALL_NAFNET if definition is NafUNet else {}
    with torch.device("meta"):
        state = definition(**options).state_dict()
    for name, shape in PUBLISHED[definition].items():
        assert tuple(state[name].shape) == shape, name


@pytest.mark.parametrize("seed", range(3))
def test_cumulative_maps_against_a_count_event_by_event(seed: int) -> None:
    """EFNet: brightness at the edges of the sixths minus brightness at the middle."""
    width, height, window = 7, 5, (9_000, 39_001 + seed)
    events = _stream(seed, 800, width, height)
    edges = np.linspace(*window, 7)
    expected = np.zeros((6, height, width))
    for t, x, y, p in zip(events.t, events.x, events.y, events.p, strict=True):
        for index, edge in enumerate(np.delete(edges, 3)):
            if edge <= t < edges[3]:
                expected[index, y, x] -= p
            if edges[3] <= t < edge:
                expected[index, y, x] += p
    maps = symmetric_cumulative(events, height, width, window)
    assert np.array_equal(maps.numpy(), expected)


@pytest.mark.parametrize("seed", range(3))
def test_event_stack_against_a_count_event_by_event(seed: int) -> None:
    """D2Net: twenty slices, darker before brighter, largest count 1."""
    width, height = 6, 4
    events = _stream(seed, 900, width, height, start=123_456)
    expected = np.zeros((40, height, width))
    start, end = int(events.t[0]), int(events.t[-1])
    for t, x, y, p in zip(events.t, events.x, events.y, events.p, strict=True):
        index = min(int((int(t) - start) * 20 // (end - start)), 19)
        expected[2 * index + (p > 0), y, x] += 1
    stack = event_stack(events, height, width)
    assert torch.allclose(stack.double(), torch.from_numpy(expected / expected.max()))
    assert event_stack(events.between(0, 1), height, width).sum() == 0


def test_mask_of_events_is_closed() -> None:
    maps = torch.zeros(6, 9, 9)
    maps[2, 4, 3], maps[5, 4, 5], maps[0, 0, 0] = 1, -2, 1
    mask = event_mask(maps)
    expected = torch.zeros(9, 9)
    expected[4, 3:6] = 1  # the gap of one pixel is filled
    expected[0, 0] = 1
    assert torch.equal(mask, expected)


@pytest.mark.parametrize("seed", range(2))
def test_local_mean_against_a_loop(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    x = torch.rand((1, 2, 11, 14), generator=generator)
    made = LocalMean(5)(x)
    for row, column in ((0, 0), (5, 7), (10, 13), (2, 12)):
        top, left = min(max(row - 2, 0), 6), min(max(column - 2, 0), 9)
        expected = x[0, :, top : top + 5, left : left + 5].mean((-2, -1))
        assert torch.allclose(made[0, :, row, column], expected, atol=1e-6)
    assert torch.allclose(LocalMean(20)(x), x.mean((-2, -1), keepdim=True))


def test_costs_find_a_shift_and_warping_undoes_it() -> None:
    features = torch.nn.functional.normalize(torch.randn(1, 32, 20, 24), dim=1)
    moved = torch.roll(features, (2, -3), (2, 3))
    best = _costs(features, moved).argmax(1)[0, 6:14, 6:18]
    assert (best == (2 + 4) * 9 + (-3 + 4)).all()
    flow = torch.tensor((-3.0, 2.0))[None, :, None, None].expand(1, 2, 20, 24)
    back = warped(moved, flow, outside="border")
    assert torch.allclose(back[..., :17, 4:], features[..., :17, 4:], atol=1e-5)
    assert back[..., 18:, :].abs().max() == 0 and back[..., :3].abs().max() == 0


@pytest.mark.parametrize("size", [(40, 50), (97, 130), (33, 200)])
def test_tiles_join_to_what_a_local_network_makes_of_the_whole(size: tuple[int, int]) -> None:
    kernel = torch.rand(1, 3, 5, 5) / 25
    seen = []

    def network(picture: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
        assert picture.shape[-1] % 4 == 0 and picture.shape[-2] % 4 == 0
        seen.append(picture.shape[-2:])
        return torch.nn.functional.conv2d(picture + other, kernel, padding=2)

    inputs = [torch.rand(1, 3, *size), torch.rand(1, 3, *size)]
    whole = torch.nn.functional.conv2d(inputs[0] + inputs[1], kernel, padding=2)
    made = in_tiles(network, inputs, multiple=4, side=64, overlap=16)
    assert made.shape == whole.shape and max(max(one) for one in seen) <= 64
    inner = (..., slice(2, size[0] - 2), slice(2, size[1] - 2))
    # only where a tile's own border is all there is of it would the two differ
    assert (made - whole)[inner].abs().mean() < 0.01 * whole.mean()
    assert made.min() > whole.min() - 1e-5 and made.max() < whole.max() + 1


@pytest.fixture(params=CHECKPOINTS)
def checkpoint(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[str, Path]:
    torch.manual_seed(0)
    path = tmp_path / WEIGHT_FILES[request.param].name
    torch.save(CHECKPOINTS[request.param](), path)
    return request.param, path


def test_a_checkpoint_is_found_loaded_whole_and_run(
    checkpoint, tiny_capture, tmp_path, monkeypatch
) -> None:
    name, path = checkpoint
    capture = tiny_capture(width=32, height=28, frames=3)
    monkeypatch.setenv(WEIGHT_FILES[name].variable, str(path))
    out = restore_capture(capture, tmp_path / "out", method=name, device="cpu")
    made = load_capture(out)
    restored = made.provenance["restored"]
    assert restored["with"] == name and restored["weights"] == path.name
    assert re.fullmatch("[0-9a-f]{64}", restored["sha256"])
    for frame in made.frames:
        assert made.image(frame).shape == (28, 32, 3)


def test_what_is_missing_or_another_file_is_said_in_a_sentence(
    checkpoint, tiny_capture, tmp_path, monkeypatch, capsys
) -> None:
    name, path = checkpoint
    file = WEIGHT_FILES[name]
    monkeypatch.delenv(file.variable, raising=False)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "nowhere"))
    capture = load_capture(tiny_capture())
    with pytest.raises(MissingWeights) as missing:
        RESTORERS[name](capture)
    for part in (file.name, file.size, "github.com", "--weights", file.variable):
        assert part in str(missing.value)
    document = torch.load(path, weights_only=True)
    tensors = document.get("params") or document.get("state_dict") or document
    first = next(key for key, value in tensors.items() if value.ndim == 4)
    tensors[first] = tensors[first][..., :1, :1].repeat(1, 1, 2, 2)
    torch.save(document, path)
    with pytest.raises(WeightsError, match=re.escape(first.removeprefix("module."))):
        RESTORERS[name](capture, weights=path)
    path.write_bytes(b"no weights")
    out = str(tmp_path / "out")
    arguments = ["restore", str(capture.path), "--with", name, "--weights", str(path)]
    assert main([*arguments, "--out", out]) == 2
    assert "not a readable PyTorch weight file" in capsys.readouterr().err
    assert not Path(out).exists()


@pytest.mark.parametrize(
    ("name", "document"),
    [
        *((name, {0: torch.zeros(2), "step": 3}) for name in CHECKPOINTS),
        ("nafnet", {"params": {"intro.weight": torch.tensor(1.0)}}),
        ("e2vid", {"config": ["model"], "state_dict": {}}),
        ("e2vid", {"model": E2VID_MODEL, "state_dict": {0: torch.zeros(2), "step": 3}}),
    ],
)
def test_a_file_without_named_tensors_is_told_in_a_sentence(
    name, document, tiny_capture, tmp_path
) -> None:
    torch.save(document, tmp_path / "other.pth")
    with pytest.raises(WeightsError, match=r"other\.pth: .*(this is not|expected) "):
        RESTORERS[name](load_capture(tiny_capture()), weights=tmp_path / "other.pth")


@pytest.mark.parametrize("key", ["num_bins", "num_encoders", "base_num_channels"])
@pytest.mark.parametrize("value", ["five", None, -3, 0, 10**9, float("inf")])
def test_a_size_that_no_e2vid_has_is_told_in_a_sentence(key, value, tiny_capture, tmp_path) -> None:
    torch.save({"model": {**E2VID_MODEL, key: value}, "state_dict": {}}, tmp_path / "other.pth")
    with pytest.raises(WeightsError, match=rf"model\.{key}: expected a whole number from 1 to"):
        RESTORERS["e2vid"](load_capture(tiny_capture()), weights=tmp_path / "other.pth")


class _Evil:
    def __reduce__(self):
        return (exec, ("raise SystemExit('ran')",))


def test_nothing_in_a_checkpoint_is_run(tmp_path, tiny_capture) -> None:
    capture = load_capture(tiny_capture())
    for name in CHECKPOINTS:
        path = tmp_path / f"{name}.pth"
        torch.save({"params": _Evil(), "state_dict": {}}, path)
        with pytest.raises(WeightsError, match="not a readable"):
            RESTORERS[name](capture, weights=path)


def test_networks_that_need_events_say_so(tiny_capture) -> None:
    path = tiny_capture()
    document = json.loads((path / "capture.json").read_text())
    (path / "capture.json").write_text(json.dumps({**document, "events": None}))
    capture = load_capture(path)
    for name in ("efnet", "d2net", "e2vid"):
        weights = path / "none"
        with pytest.raises((DataError, WeightsError), match=f"no events, which {name}|not found"):
            RESTORERS[name](capture, weights=weights)


def test_d2net_sees_neighbours_and_reverses_at_the_ends(tiny_capture) -> None:
    capture = seen(tiny_capture(frames=13))
    restorer = D2Net.__new__(D2Net)
    # frames 7 to 9 are held out: nothing looks across them
    for index, near in (
        (0, (2, 1, 0, 1, 2)),
        (3, (1, 2, 3, 4, 5)),
        (6, (4, 5, 6, 5, 4)),
        (10, (12, 11, 10, 11, 12)),
        (11, (11, 10, 11, 12, 11)),
    ):
        frame = capture.frames[index]
        pictures, stacks = restorer.inputs(capture, frame)
        for part, other in zip(pictures.chunk(5, 1), near, strict=True):
            assert torch.equal(part[0].permute(1, 2, 0), capture.image(capture.frames[other]))
        own = capture.events.between(*frame.exposure_us)
        middle = stacks[0, 40:80]
        assert torch.equal(middle, event_stack(own, *pictures.shape[-2:]))


def test_e2vid_remembers_until_reset_and_takes_many_events_in_parts(tiny_capture, tmp_path) -> None:
    torch.manual_seed(1)
    torch.save(_e2vid(), tmp_path / "e2vid.tar")
    network = E2Vid(seen(tiny_capture()), weights=tmp_path / "e2vid.tar", device="cpu")
    width, height = 30, 22
    events = _stream(0, round(0.35 * width * height * 3), width, height)
    whole = network.step(events, height, width)
    assert whole.shape == (height, width) and 0 <= whole.min() <= whole.max() <= 1
    network.reset()
    third = len(events) // 3
    for first in range(0, 3 * third, third):
        parted = network.step(_part(events, first, third), height, width)
    assert torch.allclose(parted, whole, atol=1e-5)
    assert not torch.allclose(network.step(_part(events, 0, third), height, width), parted)
