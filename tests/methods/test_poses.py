"""Noisy poses in method `evsplat`: told, smoothed, corrected, and held-out pictures unseen."""

import logging
from dataclasses import replace

import numpy as np
import pytest
import torch

from evsplat.capture import Capture, TrainingCapture, load_body_track, load_capture
from evsplat.errors import ConfigError
from evsplat.methods.evsplat import EvsplatConfig
from evsplat.methods.poses import Poses, prepare_poses
from evsplat.training.clock import Clock
from evsplat.training.trainer import Trainer

from ..firewall.scrambled import scrambled
from ..seen import seen
from ..small_model import built, small_config

SETTINGS = ("lamps=0", "most_renders=3", "event_start=0", "pose.start=0")


@pytest.fixture
def captures(tiny_capture):
    """The same recording with exact and with noisy key poses."""
    exact, noisy = tiny_capture("exact", frames=20), tiny_capture("noisy", frames=20)
    body = dict(np.load(noisy / "body.npz"))
    rng = np.random.default_rng(0)
    body["poses"] = body["poses"] + np.float32(0.05 * rng.normal(size=body["poses"].shape))
    np.savez(noisy / "body.npz", **body)
    return load_capture(exact), load_capture(noisy)


def composed(capture: Capture, *settings: str):
    return built("evsplat", capture, *SETTINGS, *settings, purpose="train")


def prepared(capture: TrainingCapture, **settings) -> Poses:
    return prepare_poses(replace(EvsplatConfig().pose, **settings), capture, announce=True)


def test_noisy_poses_are_told_and_exact_ones_stay_at_every_key(captures, caplog):
    exact, noisy = captures
    with caplog.at_level(logging.INFO):
        untouched = prepared(seen(exact))
    assert "taken as they are, corrected between keys only" in caplog.text
    assert untouched.spline is not None
    keys = untouched.track.times_us.tolist()
    assert untouched.spline.weights(keys).abs().max() < 1e-5
    assert set(untouched.priced_us).isdisjoint(keys)
    assert prepared(seen(exact), between=False).spline is None
    assert np.array_equal(untouched.track.poses, load_body_track(exact).poses)
    caplog.clear()
    with caplog.at_level(logging.INFO):
        found = prepared(seen(noisy))
    assert "smoothed in time, corrected in training" in caplog.text
    truth = load_body_track(exact).poses
    before = np.abs(load_body_track(noisy).poses - truth).mean()
    assert np.abs(found.track.poses - truth).mean() < before
    assert found.spline is not None
    assert float(found.spline.joint_rad.max()) == pytest.approx(0.05, rel=0.5)
    off = prepared(seen(noisy), smooth="never", refine="never", between=False)
    assert off.spline is None
    assert np.array_equal(off.track.poses, load_body_track(noisy).poses)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    ("cycles", "jitter", "noisy"),
    [(0.5, 0.004, True), (5.0, 0.004, False), (2.0, 0.03, True), (0.0, 0.0, False)],
)
def test_jitter_counts_against_what_lies_between_the_keys(
    seed, cycles, jitter, noisy, tiny_capture, caplog
):
    """The same jitter is a fit's on a slow motion, and hides nothing in a fast one."""
    path, rng = tiny_capture(frames=40), np.random.default_rng(seed)
    body = dict(np.load(path / "body.npz"))
    count, *joints = body["poses"].shape
    phase = 2 * np.pi * (np.linspace(0, cycles, count)[:, None, None] + rng.random(joints))
    poses = 0.3 * np.sin(phase) * (cycles > 0) + jitter * rng.normal(size=(count, *joints))
    np.savez(path / "body.npz", **body | {"poses": poses.astype(np.float32)})
    with caplog.at_level(logging.INFO):
        found = prepared(seen(path))
    assert ("are noisy: smoothed in time, corrected in training" in caplog.text) == noisy
    if noisy:
        assert found.spline is not None
        expected = max(0.02, jitter)
        assert float(found.spline.joint_rad.max()) == pytest.approx(expected, rel=0.3)


INTERPOLATION = ("policy.held_out_events=true", "pose.events_of_held_out=true")


def test_held_out_frames_move_their_poses_only(captures):
    noisy = captures[1]
    held_out = {frame.name for frame in noisy.test_frames}
    composition = composed(noisy, *INTERPOLATION)
    model, found = composition.model, composition.held_out
    assert found is not None and {frame.name for frame in found.frames} == held_out
    trainer = Trainer(
        composition, seen(noisy, held_out_events=True), Clock(8, None, shrink=False, seconds=0.0)
    )
    for _ in range(3):
        assert trainer.step() is not None
        trainer.clock.advance(0.1)
    before = {name: value.clone() for name, value in model.state_dict().items()}
    count = trainer.statistics["gaussians"].seen.clone()
    trainer.clock.iteration = found.every
    trainer._learn_held_out(5_000.0)
    changed = {
        name for name, value in model.state_dict().items() if not torch.equal(value, before[name])
    }
    assert changed == {"residual.rotations", "residual.translations"}
    assert torch.equal(count, trainer.statistics["gaussians"].seen)


def test_without_being_asked_held_out_events_teach_nothing(captures, tmp_path):
    """With other events in held-out intervals the corrected poses are the same to the last bit."""
    noisy = captures[1]
    others = scrambled(noisy.path, tmp_path / "others", 0, has_polarity=True, masks=False)

    def learned(capture: Capture, *settings: str) -> dict[str, torch.Tensor]:
        composition = composed(capture, *settings)
        policy = {"held_out_events": True} if settings else {}
        trainer = Trainer(composition, seen(capture, **policy), Clock(100, fraction=0.5))
        for _ in range(4):
            assert trainer.step() is not None
            trainer.clock.advance(0.01)
        state = composition.model.state_dict()
        return {name: value.clone() for name, value in state.items() if value.is_floating_point()}

    ours, theirs = learned(noisy), learned(load_capture(others))
    assert ours["residual.rotations"].abs().max() > 0
    assert all(torch.equal(value, theirs[name]) for name, value in ours.items())
    # where they are asked for they do teach
    asked = [learned(capture, *INTERPOLATION) for capture in (noisy, load_capture(others))]
    assert not torch.equal(asked[0]["residual.rotations"], asked[1]["residual.rotations"])


def test_events_of_held_out_frames_need_a_policy_that_shows_them(captures):
    with pytest.raises(ConfigError, match="policy.held_out_events=true as well"):
        composed(captures[1], "pose.events_of_held_out=true")


def test_events_of_held_out_frames_need_a_pose_that_is_learned(captures):
    with pytest.raises(ConfigError, match="events_of_held_out is true, and nothing reads it"):
        composed(captures[0], *INTERPOLATION, "pose.between=false")


@pytest.mark.parametrize("setting", ["pose.std_rad=0.1", "pose.std_m=0.1"])
def test_errors_expected_of_exact_poses_are_refused(captures, setting):
    exact, noisy = captures
    name = setting.partition("=")[0]
    with pytest.raises(ConfigError, match=f"{name} is 0.1, and nothing reads it: .* as exact"):
        composed(exact, setting)
    spline = composed(noisy, setting).model.residual
    found = spline.joint_rad.max() if name == "pose.std_rad" else spline.root_m
    assert float(found) == pytest.approx(0.1)


def test_a_spline_is_learned_where_it_is_asked_for(captures):
    composition = composed(captures[1])
    assert composition.held_out is None
    assert composition.model.residual is not None
    assert composition.weights["pose_prior"] == EvsplatConfig().pose.prior
    assert composed(captures[0], "pose.between=false").model.residual is None


def test_an_unknown_choice_is_named():
    with pytest.raises(ConfigError, match="pose.smooth"):
        small_config("evsplat", "pose.smooth=sometimes")
