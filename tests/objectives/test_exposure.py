"""The exposure's mean in linear light, its times, and how many renders it takes."""

import math
from types import SimpleNamespace

import pytest
import torch

from evsplat.camera import Camera
from evsplat.objectives import Exposure, motion_px, renders_for, sweep_px
from evsplat.objectives.exposure import CHROMA_START
from evsplat.pictures import CodedPictures
from evsplat.similarity import ssim


def frame(start: int = 1_000, end: int = 31_000) -> SimpleNamespace:
    return SimpleNamespace(name="a", exposure_us=(start, end), mid_us=(start + end) // 2)


@pytest.mark.parametrize("count", [3, 5, 7])
@pytest.mark.parametrize("seed", range(3))
def test_times_are_stratified_with_the_middle_among_them(count, seed):
    generator = torch.Generator().manual_seed(seed)
    objective = Exposure(None, lambda frame: count, generator)
    drawn = [objective.times(frame(), 0.0) for _ in range(50)]
    width = 30_000 / count
    for times in drawn:
        assert len(times) == count and 16_000 in times
        assert all(int((time - 1_000) // width) == k for k, time in enumerate(times))
    assert len({times[0] for times in drawn}) > 40


@pytest.mark.parametrize(
    ("motion", "expected"), [(0.0, 3), (9.0, 3), (13.0, 5), (16.0, 5), (30.0, 7), (1e4, 7)]
)
def test_the_number_of_renders_is_odd_and_follows_the_motion(motion, expected):
    assert renders_for(motion, 3.0, 7) == expected
    assert renders_for(motion, 3.0, 1) == 1
    assert renders_for(motion, 3.0, 6) == min(expected, 5)


@pytest.mark.parametrize("seed", range(3))
def test_the_loss_is_that_of_the_mean_in_linear_light_of_what_lies_inside(seed):
    generator = torch.Generator().manual_seed(seed)
    pictures = torch.rand(4, 20, 24, 3, generator=generator, dtype=torch.float64)
    observed = torch.rand(20, 24, 3, generator=generator, dtype=torch.float64)
    step = SimpleNamespace(
        nominal=CHROMA_START,
        transfer="power",
        frame=frame(),
        times_us=(500, 2_000, 16_000, 30_999),
        pictures=CodedPictures(pictures.unbind(0)),
        observed=lambda _: observed,
    )
    terms = Exposure(None, lambda frame: 3, generator).loss(step)
    blurry = (pictures[1:] ** 2.2).mean(0) ** (1 / 2.2)
    assert float(terms["l1"]) == pytest.approx(float((blurry - observed).abs().mean()), rel=1e-9)
    assert float(terms["dssim"]) == pytest.approx(1 - float(ssim(blurry, observed)), rel=1e-9)
    # The matrix of JFIF, to its six digits.
    matrix = torch.tensor([[-0.168736, -0.331264, 0.5], [0.5, -0.418688, -0.081312]]).double()
    tint = ((blurry - observed) @ matrix.T).abs().mean()
    assert float(terms["chroma"]) == pytest.approx(float(tint), rel=1e-5)
    step.nominal = CHROMA_START - 1
    assert set(Exposure(None, lambda frame: 3, generator).loss(step)) == {"l1", "dssim"}


@pytest.mark.parametrize("before", [0, 1, 3])
@pytest.mark.parametrize("after", [1, 2, 4])
@pytest.mark.parametrize("seed", range(3))
def test_renders_before_and_after_the_exposure_count_for_nothing(seed, before, after):
    generator = torch.Generator().manual_seed(seed)

    def drawn(low: int, high: int, count: int) -> list[int]:
        return torch.randint(low, high, (count,), generator=generator).tolist()

    early, inside = drawn(-40_000, 1_000, before), drawn(1_000, 31_000, 3)
    # The shutter is closed at the end itself, where the first window may begin.
    late = [31_000, *drawn(31_000, 70_000, after - 1)]
    times = sorted(early + inside + late)
    pictures = torch.rand(len(times), 16, 16, 3, generator=generator, dtype=torch.float64)
    coded = pictures.clone().requires_grad_()
    observed = torch.rand(16, 16, 3, generator=generator, dtype=torch.float64)
    step = SimpleNamespace(
        nominal=CHROMA_START,
        transfer="power",
        frame=frame(),
        times_us=tuple(times),
        pictures=CodedPictures(coded.unbind(0)),
        observed=lambda _: observed,
    )
    terms = Exposure(None, lambda frame: 3, generator).loss(step)
    seen = torch.tensor([1_000 <= time < 31_000 for time in times])
    blurry = (pictures[seen] ** 2.2).mean(0) ** (1 / 2.2)
    assert terms["l1"].item() == pytest.approx(float((blurry - observed).abs().mean()), rel=1e-9)
    assert terms["dssim"].item() == pytest.approx(1 - float(ssim(blurry, observed)), rel=1e-9)
    (terms["l1"] + terms["dssim"]).backward()
    assert torch.equal(coded.grad.flatten(1).abs().sum(1) > 0, seen)


def test_a_black_exposure_has_a_finite_gradient():
    pictures = torch.zeros(3, 16, 16, 3, requires_grad=True)
    step = SimpleNamespace(
        nominal=CHROMA_START,
        transfer="power",
        frame=frame(),
        times_us=(2_000, 16_000, 30_000),
        pictures=CodedPictures(pictures.unbind(0)),
        observed=lambda _: torch.ones(16, 16, 3),
    )
    Exposure(None, lambda frame: 3, torch.Generator()).loss(step)["l1"].backward()
    assert pictures.grad.isfinite().all()


@pytest.mark.parametrize("degrees", [0.3, 2.0])
@pytest.mark.parametrize("seed", range(2))
def test_a_camera_that_turns_sweeps_its_picture_by_the_focal_length(degrees, seed):
    """In closed form: what lies in the middle moves by f tan(a), whatever its distance."""
    distance = float(torch.empty(()).uniform_(1, 9, generator=torch.Generator().manual_seed(seed)))
    body = torch.tensor([[0.0, 0.0, distance]]).expand(26, 3)
    track = SimpleNamespace(vertices=lambda time_us: body)
    K = torch.tensor([[400.0, 0, 32.0], [0, 400.0, 24.0], [0, 0, 1]])
    angle = math.radians(degrees)
    turned = torch.eye(4)
    turned[0, 0] = turned[2, 2] = math.cos(angle)
    turned[0, 2], turned[2, 0] = math.sin(angle), -math.sin(angle)
    ends = [Camera(64, 48, K, pose) for pose in (torch.eye(4), turned)]
    middle = 400 * math.tan(angle)
    assert motion_px(ends, track, frame()) == pytest.approx(middle, rel=1e-4)
    # At the border up to 1 + (32 / 400)^2 times as far, and a little more for what it turns by.
    swept = sweep_px(ends, track, frame())
    assert middle < swept < middle * (1 + 0.08**2) * (1 + 0.1 * math.tan(angle)) + 0.05
    assert sweep_px([ends[0], ends[0]], track, frame()) == 0.0
    # Who goes along with the picture's middle hardly moves in it.
    after = body @ turned[:3, :3]
    goes = SimpleNamespace(vertices=lambda time_us: after if time_us == 31_000 else body)
    assert motion_px(ends, goes, frame()) < 1e-3
    assert sweep_px(ends, goes, frame()) > middle
