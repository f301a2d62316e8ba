"""Method `avatar3dgs_semantic`: everything starts as the person, and labels are learned."""

from dataclasses import replace

import pytest
import torch

from evsplat.capture import load_body_track, load_capture
from evsplat.methods.avatar3dgs import AvatarSemanticConfig
from evsplat.methods.starts import as_person, scene_start
from evsplat.training import load_run, train

from ..small_model import built, small


def test_all_gaussians_start_as_the_person_with_the_attribute_at_one_half(tiny_capture):
    composition = built("avatar3dgs_semantic", tiny_capture(), "human.count=80")
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
    start = replace(AvatarSemanticConfig().scene, kind=kind, cube_count=50)
    scene, _ = scene_start(start, capture, track, torch.Generator().manual_seed(1), 0.5)
    time = capture.frames[4].mid_us
    carried = as_person(scene, track, time)
    root = track.bones([time, capture.frames[0].mid_us])[:, 0]
    places = carried["means"] @ root[:, :3, :3].transpose(1, 2) + root[:, None, :3, 3]
    assert torch.allclose(places[0], scene["means"], atol=1e-4)
    assert not torch.allclose(places[1], scene["means"], atol=1e-2)
    for name in ("scales_log", "opacity_logits", "features", "semantic_logits"):
        assert torch.equal(carried[name], scene[name])


def test_labels_are_learned_by_the_papers_rule(tiny_capture, tmp_path):
    method, out = "avatar3dgs_semantic", tmp_path / "run"
    train(tiny_capture(), method=method, out=out, iterations=120, overrides=small(method))
    run = load_run(out)
    assert run.gaussians["scene"] > 0
    picture = run.reconstruction.render(run.capture.camera(run.capture.frames[0]), [20_000])
    assert bool(picture.rgb.isfinite().all())
