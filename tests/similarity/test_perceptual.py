"""LPIPS and ST-LPIPS: the graphs, and where weights are looked for."""

import hashlib
import importlib.util
import math

import pytest
import torch
from torch.nn import functional as F

from evsplat.errors import WeightsError
from evsplat.similarity.lpips import (
    HUB_FILES,
    NETWORKS,
    WEIGHTS_VARIABLE,
    load_lpips,
    lpips_heads,
)
from evsplat.similarity.st_lpips import NETWORK as ST_NETWORK
from evsplat.similarity.st_lpips import load_st_lpips
from evsplat.weights import MissingWeights

needs_st_lpips = pytest.mark.skipif(
    importlib.util.find_spec("stlpips_pytorch") is None,
    reason="needs the optional package stlpips-pytorch",
)


@pytest.fixture(autouse=True)
def nobody_has_weights(monkeypatch, tmp_path):
    """Neither the environment variable nor the hub's cache of this machine takes part."""
    monkeypatch.delenv(WEIGHTS_VARIABLE, raising=False)
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path / "hub"))


def random_state(name: str, seed: int = 0) -> dict[str, torch.Tensor]:
    """Random weights in torchvision's naming, scaled so that activations neither die nor grow."""
    generator = torch.Generator().manual_seed(seed)
    state = {}
    for key, shape in NETWORKS[name].parameter_shapes.items():
        scale = math.sqrt(2 / math.prod(shape[1:])) if len(shape) == 4 else 0.1
        state[key] = scale * torch.randn(shape, generator=generator)
    return state


def save(path, state, *, classifier: bool = False) -> None:
    """Save a state dict, with something in place of torchvision's classifier if asked for."""
    path.parent.mkdir(parents=True, exist_ok=True)
    extra = {"classifier.0.weight": torch.zeros(2, 2)} if classifier else {}
    torch.save({**state, **extra}, path)


def images(seed: int, count: int = 2, side: int = 67) -> list[torch.Tensor]:
    """Random pictures (side, side + 5, 3) in [-1, 1] with structure at several scales."""
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand(count, 3, 7, 8, generator=generator)
    fine = torch.rand(count, 3, side, side + 5, generator=generator)
    mixed = 0.8 * F.interpolate(coarse, (side, side + 5), mode="bilinear") + 0.2 * fine
    return list((2 * mixed - 1).movedim(1, -1))


def plain_lpips(a, b, state, heads, taps):
    """LPIPS written out: `taps` has (convolution, stride, padding, pool before, tapped)."""

    def features(x):
        x = x.movedim(-1, 0)[None]
        x = (x - torch.tensor([-0.030, -0.088, -0.188])[:, None, None]) / torch.tensor(
            [0.458, 0.448, 0.450]
        )[:, None, None]
        kept = []
        for index, stride, padding, pool, tapped in taps:
            if pool:
                x = F.max_pool2d(x, *pool)
            weight, bias = state[f"features.{index}.weight"], state[f"features.{index}.bias"]
            x = torch.relu(F.conv2d(x, weight, bias, stride=stride, padding=padding))
            if tapped:
                kept.append(x / (x.pow(2).sum(1, keepdim=True).sqrt() + 1e-10))
        return kept

    total = torch.zeros(())
    for first, second, head in zip(features(a), features(b), heads, strict=True):
        weighted = F.conv2d((first - second) ** 2, head[None, :, None, None])
        total = total + weighted.mean()
    return float(total)


ALEX_TAPS = [
    (0, 4, 2, None, True),
    (3, 1, 2, (3, 2), True),
    (6, 1, 1, (3, 2), True),
    (8, 1, 1, None, True),
    (10, 1, 1, None, True),
]
VGG_TAPS = [
    (0, 1, 1, None, False),
    (2, 1, 1, None, True),
    (5, 1, 1, (2, 2), False),
    (7, 1, 1, None, True),
    (10, 1, 1, (2, 2), False),
    (12, 1, 1, None, False),
    (14, 1, 1, None, True),
    (17, 1, 1, (2, 2), False),
    (19, 1, 1, None, False),
    (21, 1, 1, None, True),
    (24, 1, 1, (2, 2), False),
    (26, 1, 1, None, False),
    (28, 1, 1, None, True),
]


@pytest.mark.parametrize(("name", "taps"), [("alex", ALEX_TAPS), ("vgg", VGG_TAPS)])
def test_lpips_is_the_formula_written_out(tmp_path, name, taps):
    state = random_state(name)
    save(tmp_path / "net.pth", state, classifier=True)
    metric = load_lpips(name, tmp_path / "net.pth")
    for seed in range(2):
        a, b = images(seed)
        expected = plain_lpips(a, b, state, lpips_heads(name), taps)
        assert expected > 1e-3
        assert float(metric(a, b)) == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("name", ["alex", "vgg"])
def test_heads_fit_the_networks_and_are_not_negative(name):
    heads, shapes = lpips_heads(name), NETWORKS[name].parameter_shapes
    convolutions = [
        [shapes[f"{key}.bias"] for key, layer in stage.items() if f"{key}.bias" in shapes]
        for stage in NETWORKS[name].stages
    ]
    assert [head.shape for head in heads] == [stage[-1] for stage in convolutions]
    assert all(bool((head >= 0).all()) for head in heads)


# Computed once with the code of the package lpips 0.1.4 and the heads in its wheel, with the
# formula-defined backbone and pictures below (the trained backbones are not on any registry).
STORED_WITH_LPIPS_PACKAGE = {"alex": 0.05639035, "vgg": 0.04561223}


@pytest.mark.parametrize("name", ["alex", "vgg"])
def test_lpips_agrees_with_the_reference_package(tmp_path, name):
    save(tmp_path / "net.pth", formula_state(name))
    metric = load_lpips(name, tmp_path / "net.pth")
    a, b = formula_images()
    assert float(metric(a, b)) == pytest.approx(STORED_WITH_LPIPS_PACKAGE[name], rel=2e-5)


def formula_state(name: str) -> dict[str, torch.Tensor]:
    """Weights from a formula, so that another program can make the same ones."""
    state = {}
    for number, (key, shape) in enumerate(NETWORKS[name].parameter_shapes.items()):
        index = torch.arange(math.prod(shape), dtype=torch.float64)
        scale = math.sqrt(2 / math.prod(shape[1:])) if len(shape) == 4 else 0.1
        wave = torch.sin(12.9898 * (index + 1) + number)
        state[key] = (scale * math.sqrt(2) * wave).float().reshape(shape)
    return state


def formula_images() -> tuple[torch.Tensor, torch.Tensor]:
    """Two pictures (64, 80, 3) in [-1, 1] from a formula."""
    y, x, c = torch.meshgrid(*(torch.arange(n).double() for n in (64, 80, 3)), indexing="ij")
    first = torch.sin(x / 5 + c) * torch.cos(y / 7 - c)
    return first.float(), (0.8 * torch.sin(x / 5 + c + 0.7) * torch.cos(y / 6 - c)).float()


@needs_st_lpips
def test_st_lpips_agrees_with_its_package():
    # Stored with the code of stlpips-pytorch 0.0.2 itself; on its published example pair
    # (ex_p0 against ex_ref: 0.7777555) our graph gives the same digits.
    a, b = formula_images()
    assert float(load_st_lpips()(a, b)) == pytest.approx(0.05437046, abs=2e-5)


@needs_st_lpips
def test_st_lpips_grows_with_blur_is_symmetric_and_zero_for_equal_pictures():
    metric = load_st_lpips()
    sharp = images(5, count=1)[0]

    def blurred(size: int) -> torch.Tensor:
        padded = F.pad(sharp.movedim(-1, 0)[None], (size // 2, size // 2, 0, 0), mode="reflect")
        return F.avg_pool2d(padded, (1, size), stride=1)[0].movedim(0, -1)

    distances = [float(metric(blurred(size), sharp)) for size in (1, 3, 7, 15)]
    assert distances[0] == pytest.approx(0, abs=1e-6)
    assert distances == sorted(distances) and distances[1] > 0.005
    assert float(metric(sharp, blurred(7))) == pytest.approx(float(metric(blurred(7), sharp)))


@needs_st_lpips
def test_distance_is_differentiable():
    a, b = images(2)
    picture = a.clone().requires_grad_()
    metric = load_st_lpips()
    before = metric(picture, b)
    (gradient,) = torch.autograd.grad(before, picture)
    assert metric(a - 0.01 * gradient / gradient.abs().max(), b) < before


@pytest.mark.parametrize("network", [*NETWORKS.values(), ST_NETWORK], ids=lambda n: n.name)
def test_smallest_side_is_the_smallest_that_leaves_features(network):
    parameters = {key: torch.zeros(shape) for key, shape in network.parameter_shapes.items()}
    side, network = network.min_side, network.filled(parameters)
    features = network.features(torch.zeros(1, 3, side, side))
    assert all(min(feature.shape[2:]) >= 1 for feature in features)
    with pytest.raises(RuntimeError):
        network.features(torch.zeros(1, 3, side - 1, side - 1))


@pytest.fixture
def plain_names(monkeypatch):
    """File names without a checksum, so that random weights may stand in for the trained ones."""
    names = {"alex": "alexnet.pth", "vgg": "vgg16.pth"}
    monkeypatch.setattr("evsplat.similarity.lpips.HUB_FILES", names)
    return names


def test_weights_are_taken_from_argument_then_variable_then_hub(tmp_path, monkeypatch, plain_names):
    given, variable = tmp_path / "given.pth", tmp_path / "variable"
    files = [given, variable / "alexnet.pth", tmp_path / "hub" / "checkpoints" / "alexnet.pth"]
    for seed, file in enumerate(files):
        save(file, random_state("alex", seed))
    monkeypatch.setenv(WEIGHTS_VARIABLE, str(variable))
    assert load_lpips("alex", given).sha256 == sha256(given)
    assert load_lpips("alex").sha256 == sha256(files[1])
    monkeypatch.delenv(WEIGHTS_VARIABLE)
    assert load_lpips("alex").sha256 == sha256(files[2])


def test_a_file_of_the_other_network_leaves_the_search_going(tmp_path, plain_names):
    save(tmp_path / "given.pth", random_state("alex"))
    save(tmp_path / "hub" / "checkpoints" / "vgg16.pth", random_state("vgg"))
    found = load_lpips("vgg", tmp_path / "given.pth")
    assert found.sha256 == sha256(tmp_path / "hub" / "checkpoints" / "vgg16.pth")


@pytest.mark.parametrize("name", ["alex", "vgg"])
def test_without_weights_the_reason_names_file_and_place(name):
    with pytest.raises(MissingWeights, match=HUB_FILES[name]) as error:
        load_lpips(name)
    assert "checkpoints" in str(error.value) and WEIGHTS_VARIABLE in str(error.value)
    # Of the commands that say this one alone has the option.
    assert str(error.value).endswith("or --lpips-weights of evsplat evaluate.")


def test_missing_st_lpips_names_the_extra(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(MissingWeights, match=r"evsplat\[perceptual\]"):
        load_st_lpips()


def write_text(path) -> None:
    path.write_text("no weights")


def write_wrong_shape(path) -> None:
    state = random_state("alex")
    state["features.3.weight"] = state["features.3.weight"][:, :32]
    save(path, state)


def write_missing_key(path) -> None:
    state = random_state("alex")
    del state["features.8.bias"]
    save(path, state)


def write_additional_key(path) -> None:
    save(path, random_state("alex") | {"features.99.weight": torch.zeros(1)})


def write_list(path) -> None:
    torch.save([torch.zeros(1)], path)


@pytest.mark.parametrize(
    ("write", "says"),
    [
        (write_text, "not a readable PyTorch weight file"),
        (write_wrong_shape, "features.3.weight: expected"),
        (write_missing_key, "features.8.bias"),
        (write_additional_key, "features.99.weight"),
        (write_list, "expected a state dict"),
    ],
)
def test_a_named_file_that_is_no_network_is_an_error(tmp_path, write, says):
    write(tmp_path / "net.pth")
    with pytest.raises(WeightsError, match=says) as error:
        load_lpips("alex", tmp_path / "net.pth")
    assert not isinstance(error.value, MissingWeights)
    assert "net.pth" in str(error.value)


def test_a_named_place_that_is_missing_or_empty_is_an_error(tmp_path):
    for place in (tmp_path / "nowhere.pth", tmp_path):
        with pytest.raises(WeightsError) as error:
            load_lpips("alex", place)
        assert not isinstance(error.value, MissingWeights)


def test_a_damaged_hub_file_is_an_error(tmp_path):
    save(tmp_path / "hub" / "checkpoints" / HUB_FILES["alex"], random_state("alex"))
    with pytest.raises(WeightsError, match="damaged"):
        load_lpips("alex")


def test_weight_files_cannot_run_code(tmp_path):
    class Evil:
        def __reduce__(self):
            return (exec, ("raise SystemExit('ran')",))

    torch.save({"features.0.weight": Evil()}, tmp_path / "evil.pth")
    with pytest.raises(WeightsError, match="not a readable"):
        load_lpips("alex", tmp_path / "evil.pth")


def sha256(path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def test_one_that_keeps_features_gives_the_same_distances(tmp_path):
    save(tmp_path / "alex.pth", random_state("alex"))
    metric = load_lpips("alex", tmp_path / "alex.pth")
    shown = []
    network, features = metric.network, type(metric.network).features
    keeping = metric.keeping(1 << 30)
    first, second, third = images(0, 3)
    pairs = [(first, second), (second, first), (third, second), (first.clone(), third)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(type(network), "features", lambda *a: (shown.append(1), features(*a))[1])
        found = [float(keeping(*pair)) for pair in pairs]
        assert len(shown) == 3
        short = metric.keeping(1)
        assert [float(short(*pair)) for pair in pairs] == found
        assert len(shown) == 3 + 8
        assert [float(metric(*pair)) for pair in pairs] == found
        first.mul_(0.5)
        assert float(keeping(first, second)) == float(metric(first, second))
