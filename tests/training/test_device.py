"""A training step on another device than the CPU: nothing mixes devices, nobody waits."""

import importlib.util
import math
import sys

import pytest
import torch

from evsplat.errors import DataError
from evsplat.training.bad_steps import MAX_BAD_STEPS
from evsplat.training.clock import Clock
from evsplat.training.trainer import Trainer

from ..seen import seen
from ..small_model import built
from .foreign_device import NAME, NEEDS_DATA, ForeignDevice, Here, HostWaits, as_on_a_gpu

pytestmark = pytest.mark.filterwarnings("error:Accessing the data pointer")

# Its weights come with the extra `perceptual`.
_WEIGHTS = importlib.util.find_spec("stlpips_pytorch")
PERCEPTUAL = ("terms.perceptual=st_lpips",) if _WEIGHTS is not None else ()


def quick(capture_path, method="paper", *settings):
    """A trainer on the CPU in the middle of its schedule, without the fits before it."""
    composition = built(method, capture_path, *settings)
    return Trainer(composition, seen(capture_path), Clock(100, fraction=0.5))


def without_native(monkeypatch):
    """Plain torch everywhere but in the rasteriser."""
    for name, module in list(sys.modules.items()):
        if name.startswith("evsplat.") and not name.startswith("evsplat.render"):
            if hasattr(module, "runs_native"):
                monkeypatch.setattr(module, "runs_native", lambda tensor: False)


def test_plain_torch_takes_the_steps_that_native_takes(tiny_capture, monkeypatch):
    """All but the rasteriser, which has tests of its own: what a GPU runs in their place."""
    path = tiny_capture(width=64, height=48)
    results = []
    for native in (True, False):
        if not native:
            without_native(monkeypatch)
        trainer = quick(path)
        reports = [trainer.step() for _ in range(3)]
        results.append(reports)
    reports, expected_reports = results
    for report, expected in zip(reports, expected_reports, strict=True):
        assert report.names == expected.names
        # After an Adam step, which divides by the gradient, tiny differences have grown.
        torch.testing.assert_close(report.measured, expected.measured, rtol=2e-3, atol=1e-5)
    torch.testing.assert_close(
        reports[0].measured, expected_reports[0].measured, rtol=1e-5, atol=1e-6
    )


@pytest.mark.parametrize("method", ["paper", "evsplat"])
def test_gradients_of_the_first_step_are_those_of_native(method, tiny_capture, monkeypatch):
    path = tiny_capture(width=64, height=48)
    results = []
    for native in (True, False):
        if not native:
            without_native(monkeypatch)
        trainer = quick(path, method)
        monkeypatch.setattr(trainer.optimiser, "step", lambda *_: None)
        trainer.step()
        results.append({n: p.grad for n, p in trainer.model.named_parameters()})
    native, plain = results
    assert native.keys() == plain.keys()
    for name, expected in native.items():
        if expected is None or expected.numel() == 0:
            assert plain[name] is None
            continue
        # A place on the border of two cells of a shadow's map falls to either by how a processor
        # rounds, which changes the few entries of the relief there.
        apart = (plain[name] - expected).flatten().abs().sort().values
        kept = apart[: len(apart) - len(apart) // 1_000]
        error = (kept.norm() / expected.norm().clamp_min(1e-12)).item()
        assert error < 1e-4, (name, error)


def test_verdicts_left_on_the_device_give_the_same_steps(tiny_capture):
    """The way of a GPU, on the CPU: no step waits for its verdict; bad ones move nothing."""
    path = tiny_capture()
    at_once, later = quick(path), quick(path)
    later.bad.at_once = False
    for _ in range(3):
        assert torch.equal(at_once.step().measured, later.step().measured)
    for trainer in (at_once, later):
        features = trainer.model.gaussians.features
        whole = features.detach().clone()
        features.data[0, 0] = math.nan
        before = {k: v.clone() for k, v in trainer.state()[0].items() if "generator" not in k}
        for _ in range(2):
            trainer.step()
        for name, value in trainer.state()[0].items():
            if name in before and not name.startswith(("model.nominal", "objective", "skinning")):
                torch.testing.assert_close(value, before[name], rtol=0, atol=0, equal_nan=True)
        assert trainer.bad.settle() == 2
        features.data.copy_(whole)
    assert torch.equal(at_once.step().measured, later.step().measured)
    assert at_once.bad.skipped == later.bad.settle() == 2


def test_bad_verdicts_without_end_stop_the_training(tiny_capture):
    trainer = quick(tiny_capture())
    trainer.bad.at_once = False
    trainer.model.gaussians.features.data[0, 0] = math.nan
    for _ in range(MAX_BAD_STEPS):
        trainer.step()
    with pytest.raises(DataError, match="20 steps in a row gave a non-finite loss or gradient"):
        trainer.bad.settle()


@pytest.fixture
def foreign(monkeypatch):
    """The device, and a trainer factory for it with gsplat's functions as shapes."""

    def make(capture_path, method, *settings, fraction=0.5):
        capture = seen(capture_path)
        camera = capture.camera(capture.frames[0])
        as_on_a_gpu(device, monkeypatch, camera.width, camera.height)
        composition = built(method, capture_path, *settings, device=NAME)
        trainer = Trainer(composition, capture, Clock(100, fraction=fraction))
        trainer.data = Here()
        return trainer

    with ForeignDevice() as device:
        yield device, make


@pytest.mark.parametrize(
    ("method", "settings"),
    [
        ("paper", ()),
        ("evsplat", ("lamps=2",)),
        ("evsplat", ("lamps=2", "pose.refine=always", "clock=always")),
        ("paper", ("networks.pose_start=0", *PERCEPTUAL)),
    ],
    ids=["paper", "evsplat", "evsplat with all", "paper with all"],
)
def test_a_step_stays_on_its_device_and_never_waits(method, settings, foreign, tiny_capture):
    device, make = foreign
    trainer = make(tiny_capture(width=64, height=48), method, *settings)
    trainer.previous_nominal = trainer.clock.nominal  # densification does wait
    trainer.step()  # what is made once, such as the levels of the skeleton
    device.may_wait = False
    report = trainer.step()
    named = {"l1", "dssim", "event", "semantic"}
    if method != "evsplat":  # its person hangs on the body's own weights
        named |= {"skinning", "isometry_centers"}
    if set(PERCEPTUAL) & {*settings}:
        named |= {"st_lpips"}
    assert named <= {*report.names}
    assert report.measured.device.type == NAME
    for parameter in trainer.model.parameters():
        assert parameter.device.type == NAME
    assert trainer.statistics["gaussians"].gradient_sum.device.type == NAME


def test_a_step_of_evsplat_launches_few_operations(foreign, demo_capture_path):
    """With all that is switched on late, and as many renders as the demo's motion asks for.

    `benchmarks/launches.py` counts them by part; about 190 are around gsplat's own kernels.
    """
    device, make = foreign
    trainer = make(demo_capture_path, "evsplat", fraction=0.7)
    exposure = trainer.composition.objectives[0]
    frame = max(trainer.capture.train_frames, key=exposure.renders)
    trainer._draw_frame = lambda: frame
    trainer.previous_nominal = trainer.clock.nominal  # no densification
    trainer.step()  # what is made once
    before = device.launches
    report = trainer.step()
    assert {"chroma", "event", "pose_prior", "relief"} <= {*report.names}
    assert device.launches - before <= 800


def test_the_foreign_device_finds_what_waits_and_what_mixes(foreign):
    device, _ = foreign
    there = torch.ones(3, device=NAME)
    for waits in (
        lambda: there.sum().item(),
        lambda: bool(there[0] > 0),
        lambda: there[there > 0],
        lambda: torch.nonzero(there),
    ):
        with pytest.raises(NEEDS_DATA):
            waits()
    with pytest.raises(Exception, match="same device|two different devices"):
        there + torch.ones(3)
    torch.ones(3).to(NAME)
    device.may_wait = False
    torch.ones(3).to(NAME, non_blocking=True)
    for copies in (
        lambda: torch.ones(3).to(NAME),
        lambda: there.cpu(),
        lambda: torch.tensor([1.0, 2.0], device=NAME),
        lambda: there.new_tensor([1.0, 2.0]),
    ):
        # PyTorch makes no tensor from a list there at all; on a GPU it would, and wait.
        with pytest.raises((HostWaits, NotImplementedError)):
            copies()
