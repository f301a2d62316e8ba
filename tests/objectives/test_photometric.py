"""The picture term against its closed forms."""

from types import SimpleNamespace

import pytest
import torch

from evsplat.objectives import Photometric
from evsplat.pictures.box import Box
from evsplat.similarity import ssim


def make(seed: int, *, dssim: bool = True):
    """Two frames at 10 and 20 us, a render at each and one between that no frame saw."""
    generator = torch.Generator().manual_seed(seed)
    middles = {"a": 10, "b": 20}
    frames = [SimpleNamespace(name=n, camera="main", mid_us=mid) for n, mid in middles.items()]
    pictures = {name: torch.rand(20, 24, 3, generator=generator) for name in "ab"}
    capture = SimpleNamespace(train_frames=frames, image=lambda frame: pictures[frame.name])
    rgb = torch.rand(3, 20, 24, 3, generator=generator)
    step = SimpleNamespace(
        capture=capture, frame=frames[0], times_us=(10, 15, 20), rgb=rgb, observed=capture.image
    )
    return Photometric(capture, lambda frame: None, dssim=dssim, perceptual=None), step, pictures


@pytest.mark.parametrize("seed", range(3))
def test_only_recorded_times_are_compared_and_values_are_means(seed):
    objective, step, pictures = make(seed)
    terms = objective.loss(step)
    pairs = [(step.rgb[0], pictures["a"]), (step.rgb[2], pictures["b"])]
    l1 = sum(float((ours - theirs).abs().mean()) for ours, theirs in pairs) / 2
    similarity = sum(float(ssim(ours, theirs)) for ours, theirs in pairs) / 2
    assert float(terms["l1"]) == pytest.approx(l1, rel=1e-6)
    assert float(terms["dssim"]) == pytest.approx(1 - similarity, rel=1e-5)


def test_terms_without_weight_are_not_computed_and_the_middle_of_the_exposure_is_asked_for():
    objective, step, _ = make(0, dssim=False)
    assert set(objective.loss(step)) == {"l1"}
    assert objective.times(step.capture.train_frames[1], 0.0) == (20,)
    assert objective.state() == {}


def test_the_perceptual_distance_is_of_crops_between_minus_one_and_one_that_are_large_enough():
    plain, step, pictures = make(1)
    seen = []

    def metric(image, reference):
        seen.append((image, reference))
        return (image - reference).abs().mean()

    metric.network = SimpleNamespace(min_side=8)
    boxes = {"a": Box(2, 18, 3, 11), "b": Box(2, 18, 3, 10)}
    for chosen, crops in ((boxes, 1), (boxes | {"a": None}, 0)):
        seen.clear()
        objective = Photometric(
            step.capture, lambda frame, at=chosen: at[frame.name], dssim=True, perceptual=metric
        )
        terms = objective.loss(step)
        assert len(seen) == crops and {"l1", "dssim"} <= set(terms)
        if not crops:
            assert "perceptual" not in terms
            continue
        image, reference = seen[0]
        assert torch.equal(image, 2 * step.rgb[0][2:18, 3:11] - 1)
        assert torch.equal(reference, 2 * pictures["a"][2:18, 3:11] - 1)
        assert float(terms["perceptual"]) == pytest.approx(float((image - reference).abs().mean()))


@pytest.mark.parametrize("seed", range(3))
def test_of_cameras_with_one_trigger_each_is_compared_with_its_own_pictures(seed):
    _, step, pictures = make(seed)
    main = step.capture.train_frames
    aside = [SimpleNamespace(name=f.name * 2, camera="aside", mid_us=f.mid_us) for f in main]
    pictures |= {frame.name: 1 - pictures[frame.name[0]] for frame in aside}
    step.capture.train_frames = [frame for pair in zip(main, aside, strict=True) for frame in pair]
    objective = Photometric(step.capture, lambda frame: None, dssim=False, perceptual=None)
    for frames in (main, aside):
        step.frame = frames[seed % 2]
        pairs = zip(step.rgb[::2], frames, strict=True)
        apart = [float((rgb - pictures[frame.name]).abs().mean()) for rgb, frame in pairs]
        assert float(objective.loss(step)["l1"]) == pytest.approx(sum(apart) / 2, rel=1e-6)
