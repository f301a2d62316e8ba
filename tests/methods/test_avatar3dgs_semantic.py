"""Method `avatar3dgs_semantic`: everything starts as the person, and labels are learned."""

import pytest
import torch

from evsplat.capture import load_body_track, load_capture
from evsplat.config import override
from evsplat.methods import TRAINABLE, method_config
from evsplat.methods.starts import SceneStartConfig, as_person, scene_start
from evsplat.training import load_run, train

SMALL = (
    "human.count=80",
    "scene.backdrop_stride_px=4",
    "deform.width=16",
    "deform.colour_width=16",
    "skinning_prefit_steps=2",
    "isometry_samples=32",
    "loss.perceptual=none",
)


def test_all_gaussians_start_as_the_person_with_the_attribute_at_one_half(tiny_capture):
    config = method_config("avatar3dgs_semantic", override({}, SMALL), where="test")
    composition = TRAINABLE["avatar3dgs_semantic"].build(
        config, load_capture(tiny_capture()), 0, fit=False
    )
    gaussians = composition.model.gaussians
    assert gaussians.scene_count == 0 and gaussians.human_count > 80
    assert torch.equal(gaussians.semantic_logits, torch.full((len(gaussians),), 0.5))
    assert float(gaussians.semantics()[0].detach()) == pytest.approx(0.6225, abs=1e-4)
    # Whole pictures, no masks, no events.
    assert composition.capture is None
    assert not {"event", "alpha"} & set(composition.weights)
    assert composition.weights["l1"] == 1.0 and composition.weights["dssim"] == 0.0


@pytest.mark.parametrize("kind", ["median_backdrop", "random_cube"])
def test_scene_points_ride_on_the_root_bone_and_lie_in_place_at_one_time(tiny_capture, kind):
    capture = load_capture(tiny_capture())
    track = load_body_track(capture)
    start = SceneStartConfig(kind=kind, cube_count=50)
    scene, _ = scene_start(start, capture, track, torch.Generator().manual_seed(1), 0.5)
    time = capture.frames[4].mid_us
    carried = as_person(scene, track, time)
    root = track.bones([time, capture.frames[0].mid_us])[:, 0]
    places = carried["means"] @ root[:, :3, :3].transpose(1, 2) + root[:, None, :3, 3]
    assert torch.allclose(places[0], scene["means"], atol=1e-4)
    assert not torch.allclose(places[1], scene["means"], atol=1e-2)
    for name in ("scales_log", "opacity_logits", "features", "semantic_logits"):
        assert torch.equal(carried[name], scene[name])


@pytest.mark.parametrize("rule", ["rendered", "fixed"])
def test_labels_are_learned_by_the_papers_rule_or_stay(tiny_capture, tmp_path, rule):
    out = train(
        tiny_capture(),
        method="avatar3dgs_semantic",
        out=tmp_path / rule,
        iterations=40,
        overrides=(*SMALL, f"semantics={rule}", "optimisation.rates.semantic_logits=0.1"),
    )
    run = load_run(out)
    assert (run.gaussians["scene"] > 0) == (rule == "rendered")
    picture = run.reconstruction.render(run.capture.camera(run.capture.frames[0]), [20_000])
    assert bool(picture.rgb.isfinite().all())
