"""Method `avatar3dgs` against what is known of 3DGS-Avatar, and as a user meets it."""

import json
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from evsplat.capture import load_capture
from evsplat.cli.runs import summary_table
from evsplat.errors import ConfigError, DataError
from evsplat.evaluation.run import evaluate_run
from evsplat.methods import TRAINABLE
from evsplat.methods.avatar3dgs import AvatarConfig
from evsplat.methods.settings import weight_at
from evsplat.methods.trivial import OnMedianBackground
from evsplat.models.drawing import draw
from evsplat.models.networks import non_rigid
from evsplat.models.networks.non_rigid import draw_pose_noise
from evsplat.objectives import perceptual
from evsplat.training import load_run, train
from evsplat.training.clock import Clock
from evsplat.training.trainer import Trainer
from evsplat.weights import MissingWeights

from ..small_model import built, small, small_config


def composed(path, *settings: str):
    return built("avatar3dgs", path, *settings, seed=3)


def trainer_of(path, *settings: str, steps: int = 60) -> Trainer:
    composition = composed(path, *settings)
    return Trainer(composition, composition.capture, Clock(steps))


def forget_masks(path, *names: str) -> None:
    document = json.loads((path / "capture.json").read_text())
    for frame in document["frames"]:
        if frame["name"] in names:
            del frame["mask"]
    (path / "capture.json").write_text(json.dumps(document))


def test_settings_are_those_of_the_release(tiny_capture):
    config, extent = AvatarConfig(), 3.469298553466797
    config = replace(config, human=replace(config.human, count=100))
    config = replace(config, terms=replace(config.terms, perceptual="none"))
    capture = load_capture(tiny_capture()).for_training(config.policy)
    composition = TRAINABLE["avatar3dgs"].build(config, capture, 0, purpose="resume")
    model, learning = composition.model, composition.learning

    rows = learning.rows["gaussians"]
    assert rows["means"].rate.start == pytest.approx(1.6e-4 * extent, rel=0.02)
    starts = {"features": 1e-3, "opacity_logits": 0.05, "scales_log": 5e-3, "quaternions": 1e-3}
    assert {name: rows[name].rate.start for name in starts} == starts
    # 1.6e-4 to 1.6e-6 over 30,000 steps, of which 15,000 are made: a tenth.
    assert rows["means"].rate.final == 0.1
    assert {rows[name].rate.final for name in starts} == {1.0}
    assert {row.rate.constant for row in rows.values()} == {0.0}
    assert learning.clip == 0.1 and learning.human_start == 1_000
    found = {id(p): network for network in learning.networks for p in network.parameters}
    for part, rate, decay in (
        (model.skinning, 1e-4, 0.0),
        (model.deformation, 1e-3, 0.0),
        (model.residual, 1e-4, 0.0),
        (model.human_colour, 1e-3, 0.0),
        (model.latents, 1e-3, 0.05),
    ):
        for parameter in part.parameters():
            network = found[id(parameter)]
            assert (network.rate.start, network.rate.final, network.rate.constant) == (rate, 0.1, 0)
            assert (network.weight_decay, network.clipped) == (decay, True)

    weights = composition.weights
    assert (weights["l1"], weights["dssim"], weights["alpha"]) == (1.0, 0.0, 0.1)
    assert config.terms.perceptual_weight == 0.01
    assert (weights["isometry_centers"], weights["isometry_covariances"]) == (1.0, 100.0)
    skinning = [weight_at(weights["skinning"], n) for n in (0, 999, 1_000, 14_999)]
    assert skinning == [10, 10, 0.1, 0.1]
    limits = composition.densify["human"]
    assert (limits.start, limits.end, limits.every) == (1_000, 10_000, 100)
    assert (limits.gradient, limits.prune_opacity) == (2e-4, 0.05)
    assert limits.split_above_m == pytest.approx(0.01 * extent, rel=0.02)
    assert (limits.prune_after, limits.prune_screen_px) == (3_000, 20)
    assert limits.prune_scale_m == pytest.approx(0.1 * extent, rel=0.02)
    assert config.iterations == 15_000

    assert (model.non_rigid_start, model.residual_start) == (3_000, 5_000)
    assert (model.pose_noise, non_rigid._NOISE_PROBABILITY) == (0.1, 0.5)
    generator = torch.Generator().manual_seed(0)
    noises = [draw_pose_noise(3, 0.1, generator, torch.device("cpu")) for _ in range(400)]
    drawn = torch.stack([noise for noise in noises if torch.is_tensor(noise)])
    assert len(drawn) / 400 == pytest.approx(0.5, abs=0.1)
    assert float(drawn.std()) == pytest.approx(0.1, rel=0.05)
    networks = (model.deformation.network.mlp, model.skinning.mlp, model.human_colour.mlp)
    assert [len(mlp.first_bias) for mlp in networks] == [128, 128, 64]
    assert [len(mlp.weights) for mlp in networks] == [3, 4, 2]
    assert model.latents.values.shape[1] == 16


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
    with pytest.raises(DataError, match="1 of 7 .*'0002'.*evsplat masks [^ ]*tiny, or"):
        composed(path)
    forget_masks(path, *(f"{index:04d}" for index in range(10) if index not in (2, 8)))
    # none is left that somebody else made
    with pytest.raises(DataError, match="7 of 7 .* no mask.*evsplat masks .*tiny --in-place, or"):
        composed(path)


def test_missing_masks_before_a_moving_camera_are_made_of_silhouettes(tiny_capture):
    """Estimates by a static background would be refused next."""
    path = tiny_capture()
    forget_masks(path, "0002")
    document = json.loads((path / "capture.json").read_text())
    pose = document["cameras"]["main"]["world_to_camera"]
    for number, frame in enumerate(document["frames"]):
        aside = pose[0][:3] + [pose[0][3] + 1e-4 * number]
        frame["world_to_camera"] = [aside, *pose[1:]]
    (path / "capture.json").write_text(json.dumps(document))
    with pytest.raises(DataError, match="make them with: evsplat masks .*silhouette") as refusal:
        composed(path)
    assert "estimated" not in str(refusal.value)


def test_masks_that_the_policy_hides_are_not_looked_for(tiny_capture):
    with pytest.raises(ConfigError, match="policy.masks is none, and method avatar3dgs"):
        composed(tiny_capture(), "policy.masks=none")


@pytest.mark.parametrize(
    "setting", ["lamps=2", "scene.kind=random_cube", "semantic_weight=0.1", "event_weight=0.1"]
)
def test_settings_of_a_scene_and_of_events_are_refused(setting):
    with pytest.raises(ConfigError, match=f"unknown setting {setting.partition('.')[0][:5]}"):
        small_config("avatar3dgs", setting)


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
    drawing = draw(model.at([frame.mid_us], camera.center()), camera)
    assert torch.allclose(drawing.semantic[0], drawing.output.alpha[0], atol=1e-6)
    expected = (drawing.output.alpha[0] - capture.human(frame).float()).abs().mean()
    assert terms["alpha"] == pytest.approx(float(expected.detach()), rel=1e-4)
    drawing.semantic[0].sum().backward()
    assert bool((model.gaussians.opacity_logits.grad > 0).any())
    assert not model.gaussians.semantic_logits.grad.any()


def test_the_schedule_freezes_the_person_then_deforms_then_corrects_poses(tiny_capture):
    trainer = trainer_of(tiny_capture(), "densify.start=15000", steps=60)
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
    assert first_moved["deformation.network.mlp.weights.0"] == 3_000
    assert first_moved["deformation.pose_encoder.root_weight"] == 3_000
    assert first_moved["residual.rotations"] == first_moved["residual.translations"] == 5_000
    assert first_moved["latents.values"] == 0
    still = {name for name, value in model.named_parameters() if value.numel()} - set(first_moved)
    assert all(name.startswith(("scene_colour", "gaussians.semantic")) for name in still), still


@pytest.mark.parametrize("method", ["avatar3dgs", "paper"])
def test_unseen_frames_are_treated_as_released_or_interpolated(tiny_capture, method):
    path = tiny_capture()
    capture = load_capture(path)
    times = [frame.mid_us for frame in capture.train_frames]
    between = (times[2] + times[3]) // 2
    center = capture.camera(capture.frames[0]).center()
    model = built(method, path, "networks.pose_start=5000").model
    model.nominal.fill_(10_000.0)
    latents, shifts = model.latents.values, model.residual.translations
    with torch.no_grad():
        latents.normal_()
        shifts.normal_()
        model.human_colour.mlp.weights[0].normal_()

    def moved(time: int) -> torch.Tensor:
        """How far the root is from where the track has it."""
        rotations, bones = model.pose([time])
        given = model.track.body.canonical_to_world(rotations, model.track.at([time])[1])
        return (bones - given)[0, 0, :3, 3]

    expected = torch.zeros(3) if method == "avatar3dgs" else shifts[2:4].mean(0)
    assert torch.allclose(moved(between), expected, atol=1e-5)
    assert torch.allclose(moved(times[0]), shifts[0], atol=1e-5)
    # The colour of a frame that was not seen: its latent stands in for another one.
    colours = model.at([between], center).human.channels[..., :3]
    with torch.no_grad():
        latents[:] = latents[-1] if method == "avatar3dgs" else latents[2:4].mean(0)
    again = model.at([between], center).human.channels[..., :3]
    assert torch.allclose(again, colours, atol=1e-5)


def test_a_resumed_run_equals_the_uninterrupted_one(tiny_capture):
    path = tiny_capture()

    def trainer() -> Trainer:
        """One that edits every second step, so that statistics are part of what is saved."""
        composition = composed(path)
        composition.densify["human"] = replace(composition.densify["human"], every=1_500)
        return Trainer(composition, composition.capture, Clock(16))

    whole, broken = trainer(), trainer()
    for one, steps in ((whole, 12), (broken, 7)):
        for _ in range(steps):
            assert one.step() is not None
            one.clock.advance(0.1)
    saved = broken.state()
    resumed = trainer()
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
    trainer = trainer_of(tiny_capture(), "terms.perceptual=available")
    assert "No perceptual term lpips_vgg: LPIPS VGG16: no weights." in caplog.text
    assert trainer.composition.weights["st_lpips"] == 0.01
    assert trainer.step().terms["st_lpips"] > 0
    monkeypatch.setattr(perceptual, "load_st_lpips", missing)
    without = trainer_of(tiny_capture("b"), "terms.perceptual=available")
    assert "st_lpips" not in without.step().terms


def test_a_run_is_trained_read_back_measured_and_drawn(tiny_capture, tmp_path, monkeypatch):
    overrides, out = small("avatar3dgs"), tmp_path / "run"
    out = train(tiny_capture(), method="avatar3dgs", out=out, iterations=10, overrides=overrides)
    metrics = evaluate_run(out, device="cpu")
    assert metrics["method"] == "avatar3dgs" and metrics["gaussians"]["scene"] == 0
    # Weights that only training needs are not read, and need not be there.
    record = json.loads((out / "versions.json").read_text())
    del record["settings"]  # as of a run whose settings nobody wrote down
    (out / "versions.json").write_text(json.dumps(record))
    settings = out / "config.yaml"
    settings.write_text(settings.read_text().replace("perceptual: none", "perceptual: lpips_vgg"))
    monkeypatch.setattr(perceptual, "load_lpips", None)
    run = load_run(out)
    assert run.human_only and run.config.terms.perceptual == "lpips_vgg"
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
