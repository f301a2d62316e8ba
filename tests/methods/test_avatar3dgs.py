"""Method `avatar3dgs` against what is known of 3DGS-Avatar, and as a user meets it."""

import json
from types import SimpleNamespace

import pytest
import torch

from evsplat.capture import load_capture
from evsplat.cli.summary import summary_table
from evsplat.config import override
from evsplat.models.drawing import draw
from evsplat.errors import ConfigError, DataError
from evsplat.evaluation.run import evaluate_run
from evsplat.methods import TRAINABLE, method_config
from evsplat.methods.avatar3dgs import AvatarConfig
from evsplat.methods.backdrop import OnMedianBackground
from evsplat.methods.settings import weight_at
from evsplat.objectives import perceptual
from evsplat.training import load_run, train
from evsplat.training.clock import Clock
from evsplat.training.trainer import Trainer
from evsplat.weights import MissingWeights

SMALL = (
    "human.count=120",
    "deform.width=16",
    "deform.colour_width=16",
    "skinning_prefit_steps=2",
    "isometry_samples=32",
    "densify_human.max_count=150",
    "loss.perceptual=none",
)


def composed(path, *settings: str, fit: bool = False):
    config = method_config("avatar3dgs", override({}, (*SMALL, *settings)), where="test")
    return TRAINABLE["avatar3dgs"].build(
        config, load_capture(path).for_training(config.policy), 3, fit=fit
    )


def trainer_of(path, *settings: str, steps: int = 60) -> Trainer:
    composition = composed(path, *settings)
    return Trainer(composition, composition.capture, Clock(steps))


def forget_masks(path, *names: str) -> None:
    document = json.loads((path / "capture.json").read_text())
    for frame in document["frames"]:
        if frame["name"] in names:
            del frame["mask"]
    (path / "capture.json").write_text(json.dumps(document))


def test_settings_are_those_of_the_release():
    config = AvatarConfig()
    rates, loss, limits = config.optimisation.rates, config.loss, config.densify_human
    extent = 3.469298553466797
    assert rates.means == pytest.approx(1.6e-4 * extent, rel=0.02)
    # 1.6e-4 to 1.6e-6 over 30,000 steps, of which 15,000 are made: a tenth.
    assert (rates.means_final, rates.constant, rates.gaussians_final) == (0.1, 0.0, 1.0)
    assert (rates.features, rates.opacity_logits, rates.scales_log) == (1e-3, 0.05, 5e-3)
    assert (rates.quaternions, rates.clip_networks, rates.latent_weight_decay) == (1e-3, 0.1, 0.05)
    networks = (rates.skinning, rates.non_rigid, rates.pose_correction, rates.colour, rates.latents)
    assert networks == (1e-4, 1e-3, 1e-4, 1e-3, 1e-3) and rates.final == 0.1
    assert (loss.l1, loss.dssim, loss.alpha, loss.perceptual_weight) == (1.0, 0.0, 0.1, 0.01)
    assert (loss.isometry_centers, loss.isometry_covariances) == (1.0, 100.0)
    assert [weight_at(loss.skinning, n) for n in (0, 999, 1_000, 14_999)] == [10, 10, 0.1, 0.1]
    assert (limits.start, limits.end, limits.every) == (1_000, 10_000, 100)
    assert (limits.gradient, limits.prune_opacity) == (2e-4, 0.05)
    assert limits.split_above_m == pytest.approx(0.01 * extent, rel=0.02)
    assert (limits.prune_after, limits.prune_screen_px) == (3_000, 20)
    assert limits.prune_scale_m == pytest.approx(0.1 * extent, rel=0.02)
    deform = config.deform
    assert (deform.non_rigid_start, deform.pose_correction_start) == (3_000, 5_000)
    assert (deform.pose_noise, deform.pose_noise_probability) == (0.1, 0.5)
    assert (deform.width, deform.non_rigid_depth, deform.skinning_depth) == (128, 3, 4)
    assert (deform.latent_dim, deform.colour_width) == (16, 64)
    assert config.optimisation.iterations == 15_000
    assert config.optimisation.human_start == 1_000


def test_the_person_alone_is_learned_from_pictures_that_are_black_elsewhere(tiny_capture):
    path = tiny_capture()
    composition = composed(path)
    raw, masked = load_capture(path), composition.capture
    for frame in raw.train_frames:
        person = raw.mask(frame) > 0.5
        assert 0 < person.float().mean() < 1
        assert torch.equal(masked.image(frame), raw.image(frame) * person[..., None])
    gaussians = composition.model.gaussians
    assert gaussians.scene_count == 0
    assert torch.equal(gaussians.semantics(), torch.ones(len(gaussians)))
    assert set(composition.densify) == {"human"}


def test_missing_masks_are_told_with_what_to_do(tiny_capture):
    path = tiny_capture()
    forget_masks(path, "0008")
    composed(path)  # a held-out frame needs none
    forget_masks(path, "0002")
    with pytest.raises(DataError, match="1 of 7 .*'0002'.*evsplat masks .*tiny"):
        composed(path)
    forget_masks(path, *(f"{index:04d}" for index in range(10) if index not in (2, 8)))
    with pytest.raises(DataError, match="7 of 7 training frames have no mask.*evsplat masks"):
        composed(path)


def test_masks_that_the_policy_hides_are_not_looked_for(tiny_capture):
    with pytest.raises(ConfigError, match="policy.masks is none, and method avatar3dgs"):
        composed(tiny_capture(), "policy.masks=none")


def test_settings_of_a_scene_are_refused(tiny_capture):
    with pytest.raises(ConfigError, match="deform.shadow_lights is 2.*has no scene"):
        composed(tiny_capture(), "deform.shadow_lights=2")


def test_the_mask_term_is_the_distance_of_alpha_and_mask(tiny_capture):
    trainer = trainer_of(tiny_capture())
    terms = trainer.step().terms
    assert set(terms) == {"l1", "alpha", "skinning", "isometry_centers", "isometry_covariances"}
    composition = composed(tiny_capture("again"))
    model, capture = composition.model, composition.capture
    # Both start at the same seed; the first step changes nothing before it measures.
    order = torch.randperm(len(capture.train_frames), generator=composition.generator)
    frame = capture.train_frames[int(order[-1])]
    camera = capture.camera(frame)
    drawing = draw(model, model.at([frame.mid_us], camera.center()), camera)
    assert torch.allclose(drawing.semantic[0], drawing.output.alpha[0], atol=1e-6)
    expected = (drawing.output.alpha[0] - capture.person(frame).float()).abs().mean()
    assert terms["alpha"] == pytest.approx(float(expected.detach()), rel=1e-4)
    drawing.semantic[0].sum().backward()
    assert bool((model.gaussians.opacity_logits.grad > 0).any())
    assert not model.gaussians.semantic_logits.grad.any()


def test_the_schedule_freezes_the_person_then_deforms_then_corrects_poses(tiny_capture):
    trainer = trainer_of(tiny_capture(), "densify_human.start=15000", steps=60)
    model = trainer.model
    last = {name: value.detach().clone() for name, value in model.named_parameters()}
    first_moved: dict[str, float] = {}
    while trainer.clock.iteration < 24:
        nominal = trainer.clock.nominal
        assert trainer.step() is not None
        trainer.clock.advance(0.1)
        for name, value in model.named_parameters():
            if not torch.equal(value, last[name]):
                first_moved.setdefault(name, nominal)
            last[name] = value.detach().clone()
    assert first_moved["gaussians.means"] == 1_000
    assert first_moved["gaussians.features"] == 1_000
    assert first_moved["skinning.mlp.weights.0"] == 0
    assert first_moved["human_colour.mlp.weights.0"] == 0
    assert first_moved["non_rigid.mlp.weights.0"] == 3_000
    assert first_moved["pose_encoder.root_weight"] == 3_000
    assert first_moved["rotation_residuals"] == first_moved["translation_residuals"] == 5_000
    assert first_moved["latents"] == 0
    still = {name for name, value in model.named_parameters() if value.numel()} - set(first_moved)
    assert all(name.startswith(("scene_colour", "gaussians.semantic")) for name in still), still


def test_unseen_frames_are_treated_as_released_or_interpolated(tiny_capture):
    path = tiny_capture()
    capture = load_capture(path)
    times = [frame.mid_us for frame in capture.train_frames]
    between = (times[2] + times[3]) // 2
    center = capture.camera(capture.frames[0]).center()
    for rule in ("released", "interpolated"):
        model = composed(path, f"deform.unseen_frames={rule}").model
        model.nominal.fill_(10_000.0)
        with torch.no_grad():
            model.latents.normal_()
            model.translation_residuals.normal_()
            model.human_colour.mlp.weights[0].normal_()
        given = model.track.at([between])[1]
        moved = (
            model.pose([between])[1][0]
            - model.track.body.canonical_to_world(model.pose([between])[0], given)[0]
        )
        shift = moved[0, :3, 3]
        around = model.translation_residuals[2:4].mean(0)
        expected = torch.zeros(3) if rule == "released" else around
        assert torch.allclose(shift, expected, atol=1e-5)
        at_frame = model.pose(times[:1])[1][0, 0, :3, 3]
        raw = model.track.body.canonical_to_world(
            model.pose(times[:1])[0], model.track.at(times[:1])[1]
        )[0, 0, :3, 3]
        assert torch.allclose(at_frame - raw, model.translation_residuals[0], atol=1e-5)
        # The colour of a frame that was not seen: its latent stands in for another one.
        colours = model.at([between], center).human.rgb
        other = model.latents[-1] if rule == "released" else model.latents[2:4].mean(0)
        with torch.no_grad():
            model.latents[:] = other
        assert torch.allclose(model.at([between], center).human.rgb, colours, atol=1e-5)


def test_a_resumed_run_equals_the_uninterrupted_one(tiny_capture):
    path = tiny_capture()
    settings = ("deform.skinning_turns=1", "densify_human.every=1500")
    whole = trainer_of(path, *settings, steps=16)
    broken = trainer_of(path, *settings, steps=16)
    for trainer, steps in ((whole, 12), (broken, 7)):
        for _ in range(steps):
            assert trainer.step() is not None
            trainer.clock.advance(0.1)
    saved = broken.state()
    resumed = trainer_of(path, *settings, steps=16)
    resumed.load_state(*saved)
    for _ in range(5):
        resumed.step()
        resumed.clock.advance(0.1)
    expected, found = whole.state()[0], resumed.state()[0]
    assert expected.keys() == found.keys()
    assert [name for name in expected if not torch.equal(expected[name], found[name])] == []


def test_the_perceptual_term_has_the_name_of_what_ran(tiny_capture, monkeypatch, caplog):
    caplog.set_level("INFO")

    class Distance:
        network = SimpleNamespace(min_side=2)

        def __call__(self, image, reference):
            return (image - reference).abs().mean()

    def missing(*_, **__):
        raise MissingWeights("LPIPS VGG16: no weights.")

    monkeypatch.setattr(perceptual, "load_lpips", missing)
    monkeypatch.setattr(perceptual, "load_st_lpips", lambda **_: Distance())
    trainer = trainer_of(tiny_capture(), "loss.perceptual=available")
    assert "No perceptual term lpips_vgg: LPIPS VGG16: no weights." in caplog.text
    assert trainer.composition.weights["st_lpips"] == 0.01
    assert trainer.step().terms["st_lpips"] > 0
    monkeypatch.setattr(perceptual, "load_st_lpips", missing)
    without = trainer_of(tiny_capture("b"), "loss.perceptual=available")
    assert "st_lpips" not in without.step().terms


def test_a_run_is_trained_read_back_measured_and_drawn(tiny_capture, tmp_path, monkeypatch):
    out = train(
        tiny_capture(), method="avatar3dgs", out=tmp_path / "run", iterations=10, overrides=SMALL
    )
    metrics = evaluate_run(out, device="cpu")
    assert metrics["method"] == "avatar3dgs" and metrics["gaussians"]["scene"] == 0
    # Weights that only training needs are not read, and need not be there.
    settings = out / "config.yaml"
    settings.write_text(settings.read_text().replace("perceptual: none", "perceptual: lpips_vgg"))
    monkeypatch.setattr(perceptual, "load_lpips", None)
    run = load_run(out)
    assert run.human_only and run.config.loss.perceptual == "lpips_vgg"
    frame = run.capture.test_frames[0]
    camera = run.capture.camera(frame)
    both = run.reconstruction.render(camera, [frame.mid_us])
    alone = run.reconstruction.render(camera, [frame.mid_us], parts="human")
    nothing = run.reconstruction.render(camera, [frame.mid_us], parts="scene")
    assert torch.equal(both.rgb, alone.rgb) and bool((both.rgb > 0).any())
    assert not nothing.rgb.any() and not nothing.alpha.any()
    assert torch.allclose(both.human, both.alpha, atol=1e-6)

    # Black is no background: the person is measured before the median of the frames as well.
    median = run.capture.median_background()
    composited = OnMedianBackground(run.reconstruction, run.capture)
    picture = composited.render(camera, [frame.mid_us])
    expected = both.rgb + (1 - both.alpha[..., None]) * median
    assert torch.allclose(picture.rgb, expected, atol=1e-6)
    assert torch.equal(picture.human, both.human) and bool((picture.alpha == 1).all())
    scene = composited.render(camera, [frame.mid_us], parts="scene")
    assert torch.equal(scene.rgb[0], median)
    for protocol, regions in metrics["composited"].items():
        black = metrics["protocols"][protocol]
        assert regions["full"]["psnr"] > black["full"]["psnr"] + 3
    table = (out / "metrics.md").read_text()
    assert table.count("the same person on the median background") == 3
    assert "on_median_background" in summary_table(metrics)
