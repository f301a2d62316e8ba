"""Whatever is held out, methods, restorers and maskers make the same of a recording, bit for bit.

Everything that training may not see is replaced by noise; the terms of the default policy.
"""

import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import pytest
import torch
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from torch import Tensor

from evsplat.calibration import noise_of
from evsplat.capture import Policy, TrainingCapture, estimate_sensor, load_capture
from evsplat.errors import DataError
from evsplat.masks import MASKERS
from evsplat.masks.rvm import FILE
from evsplat.methods import TRAINABLE
from evsplat.methods.trivial import MedianBackground, NearestFrame
from evsplat.restore import RESTORERS
from evsplat.training.clock import Clock
from evsplat.training.run import seen_by_training
from evsplat.training.trainer import Trainer

from ..masks.test_rvm import Counting, save_network
from ..restore.test_networks import CHECKPOINTS
from ..small_model import few_descent_steps, small_config
from .scrambled import Recorded, recordings, scrambled, write_recorded

pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit:DeprecationWarning")
# An example that fails is as good as a smaller one, which would take minutes to find.
few = partial(
    settings,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
    phases=[Phase.explicit, Phase.reuse, Phase.generate],
)

QUICK = ("lamps=1", "most_renders=3")
ALL = ("pose.refine=always", "pose.smooth=always")
METHODS = {
    "evsplat": ("evsplat", QUICK),
    "evsplat with all that can be switched on": ("evsplat", (*QUICK, *ALL, "clock=always")),
    "evsplat with the paper's events": ("evsplat", (*QUICK, "event_term=paper")),
    "paper": ("paper", ()),
    "paper with corrected poses": ("paper", ("networks.pose_start=0", "semantics=ste")),
    "avatar3dgs": ("avatar3dgs", ()),
    "avatar3dgs with estimated masks": ("avatar3dgs", ("policy.masks=estimated",)),
    "avatar3dgs_semantic": ("avatar3dgs_semantic", ()),
    "hugs": ("hugs", ("scene.cube_count=300",)),
    "hugs, interpolated poses": (
        "hugs",
        ("scene.cube_count=300", "policy.held_out_poses=interpolated"),
    ),
}
assert {method for method, _ in METHODS.values()} == set(TRAINABLE)


@contextmanager
def both(recorded: Recorded, noise: int, *, masks: bool) -> Iterator[tuple[Path, Path]]:
    """The recording, and the same with noise in what is held out."""
    with tempfile.TemporaryDirectory() as folder:
        path = write_recorded(Path(folder) / "tiny", recorded)
        yield path, scrambled(path, Path(folder) / "noise" / "tiny", noise, masks=masks,
                              has_polarity=recorded.has_polarity)  # fmt: skip


def two_steps(path: Path, method: str, assignments: tuple[str, ...]) -> dict[str, Tensor]:
    """All that is left of two training steps in the middle of the schedule."""
    config = small_config(method, *assignments)
    capture = seen_by_training(load_capture(path), config)
    composition = TRAINABLE[method].build(config, capture, 0)
    trainer = Trainer(composition, composition.capture or capture, Clock(100, fraction=0.5))
    losses = [trainer.step() for _ in range(2)]
    assert all(report is not None for report in losses)
    measured = torch.cat([report.measured for report in losses if report is not None])
    return {**trainer.state()[0], "measured": measured}


def same(ours: dict[str, Tensor], others: dict[str, Tensor]) -> bool:
    return ours.keys() == others.keys() and all(
        torch.equal(value.nan_to_num(), others[name].nan_to_num()) for name, value in ours.items()
    )


@pytest.mark.parametrize("name", METHODS)
@given(recorded=recordings(), noise=st.integers(0, 1_000))
@few(max_examples=3)
def test_two_training_steps_know_nothing_of_what_is_held_out(name, recorded, noise, monkeypatch):
    few_descent_steps(monkeypatch)
    method, assignments = METHODS[name]
    given_masks = method in ("avatar3dgs", "hugs") and "policy.masks=estimated" not in assignments
    with both(recorded, noise, masks=given_masks) as (path, noisy):
        ours, others = (two_steps(p, method, assignments) for p in (path, noisy))
        assert same(ours, others)


def test_events_of_held_out_frames_teach_where_the_policy_shows_them():
    """The noise reaches what it should: without the firewall the same test fails."""
    recorded = Recorded(frozenset({4, 7, 8, 9}), 0, True, True, 1)
    assignments = (*QUICK, "policy.held_out_events=true")
    with both(recorded, 0, masks=False) as (path, noisy):
        ours, others = (two_steps(p, "evsplat", assignments) for p in (path, noisy))
        assert not same(ours, others)


@given(recorded=recordings(), noise=st.integers(0, 1_000))
@few(max_examples=15)
def test_sensor_estimates_and_trivial_rows_know_nothing_of_what_is_held_out(recorded, noise):
    def found(capture: TrainingCapture) -> list[object]:
        estimate, measured = estimate_sensor(capture), noise_of(capture.events)
        told = None if estimate is None else (estimate.clock.lag_us, estimate.thresholds)
        held_out = capture.held_out_frames[0]
        pictures = [
            kind(capture).render(capture.camera(held_out), [held_out.mid_us]).rgb.tolist()
            for kind in (MedianBackground, NearestFrame)
        ]
        hot = measured.hot_pixels.tolist()
        return [told, measured.rate_hz, measured.brighter_share, measured.floor_hz, hot, pictures]

    with both(recorded, noise, masks=False) as paths:
        assert found(_strict(paths[0])) == found(_strict(paths[1]))


@pytest.fixture(scope="session")
def checkpoint(tmp_path_factory) -> Callable[[str], Path]:
    """Weights of a restorer's network, made up once."""
    folder = tmp_path_factory.mktemp("checkpoints")

    def write(name: str) -> Path:
        path = folder / f"{name}.pth"
        if not path.exists():
            torch.manual_seed(0)
            torch.save(CHECKPOINTS[name](), path)
        return path

    return write


@pytest.mark.parametrize("name", RESTORERS)
@given(recorded=recordings(has_polarity=True), noise=st.integers(0, 1_000))
@few(max_examples=2)
def test_restored_training_frames_know_nothing_of_what_is_held_out(
    name, recorded, noise, checkpoint
):
    options = {"weights": checkpoint(name)} if name in CHECKPOINTS else {}
    frame_by_frame = name in ("nafnet", "mprnet", "efnet", "d2net")

    def restored(capture: TrainingCapture) -> list[Tensor]:
        restorer = RESTORERS[name](capture, **options)
        frames = capture.train_frames
        if frame_by_frame:  # slow ones: a frame beside a held-out one says as much as all
            frames = [f for f in frames if f.index + 1 in recorded.held_out or f is frames[0]][-1:]
        return [picture for _, picture in restorer.restore(capture, frames)]

    with both(recorded, noise, masks=False) as (path, noisy):
        ours, others = (_or_error(restored, _strict(p)) for p in (path, noisy))
        assert len(ours) == len(others) > 0
        assert all(torch.equal(a, b) for a, b in zip(ours, others, strict=True))


@pytest.mark.parametrize("name", MASKERS)
@given(recorded=recordings(), noise=st.integers(0, 1_000))
@few(max_examples=6)
def test_masks_of_training_frames_know_nothing_of_what_is_held_out(
    name, recorded, noise, tmp_path_factory
):
    options = {}
    if name == "rvm":
        folder = tmp_path_factory.getbasetemp()
        options["weights"] = save_network(Counting(), folder / FILE)

    def masks(capture: TrainingCapture) -> list[Tensor]:
        masker = MASKERS[name](capture, **options)
        return [mask for _, mask in masker.masks(capture, capture.train_frames)]

    with both(recorded, noise, masks=False) as (path, noisy):
        ours, others = masks(_strict(path)), masks(_strict(noisy))
        assert len(ours) == len(others) > 0
        assert all(torch.equal(a, b) for a, b in zip(ours, others, strict=True))


def _strict(path: Path) -> TrainingCapture:
    return load_capture(path).for_training(Policy())


def _or_error(
    restored: Callable[[TrainingCapture], list[Tensor]], capture: TrainingCapture
) -> list[Tensor]:
    """What is restored; of a recording too short for thresholds the message, as numbers."""
    try:
        return restored(capture)
    except DataError as error:
        message = str(error).replace(str(capture.path), "")
        return [torch.tensor([ord(letter) for letter in message])]
