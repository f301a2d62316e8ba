"""Poses that err in method `evsplat`: told, smoothed, corrected, held-out pictures unseen."""

import json
import logging
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from evsplat.body import BodyTrack, PoseErrors
from evsplat.capture import Capture, TrainingCapture, load_body_track, load_capture
from evsplat.errors import ConfigError
from evsplat.methods import poses
from evsplat.methods.evsplat import ERRORS_RATE
from evsplat.methods.evsplat_settings import EvsplatConfig
from evsplat.methods.poses import Poses, prepare_poses
from evsplat.models.pose_correction import SHARES
from evsplat.objectives import DeformationPrior
from evsplat.posing.refine import Verdict
from evsplat.training.clock import Clock
from evsplat.training.trainer import Trainer

from ..firewall.scrambled import scrambled
from ..seen import seen
from ..small_model import built, few_descent_steps, small_config

SETTINGS = ("lamps=0", "most_renders=3", "event_start=0", "pose.start=0")


def with_errors(path: Path, **fields) -> None:
    """Write fields of body.npz (None leaves one out), and ``source`` into capture.json."""
    source = fields.pop("source", None)
    with np.load(path / "body.npz") as archive:
        body = dict(archive) | fields
    np.savez(
        path / "body.npz", **{name: value for name, value in body.items() if value is not None}
    )
    if source is not None:
        document = json.loads((path / "capture.json").read_text("utf-8"))
        document["body"]["source"] = source or None
        (path / "capture.json").write_text(json.dumps(document), "utf-8")


@pytest.fixture(autouse=True)
def _few_steps(monkeypatch):
    few_descent_steps(monkeypatch)


@pytest.fixture
def captures(tiny_capture):
    """The same recording with exact and with noisy key poses, which say so."""
    exact, noisy = tiny_capture("exact", frames=20), tiny_capture("noisy", frames=20)
    poses = load_capture(noisy).body_file.poses
    rng = np.random.default_rng(0)
    poses = poses + np.float32(0.05 * rng.normal(size=poses.shape))
    std = np.full(poses.shape[:2], 0.05, np.float32)
    place = np.full((len(poses), 3), 0.01, np.float32)
    with_errors(noisy, source="estimated", poses=poses, pose_std_rad=std, transl_std_m=place)
    with_errors(exact, source="exact")
    return load_capture(exact), load_capture(noisy)


def composed(capture: Capture, *settings: str):
    return built("evsplat", capture, *SETTINGS, *settings, purpose="train")


def prepared(capture: TrainingCapture, **settings) -> Poses:
    return prepare_poses(replace(EvsplatConfig().pose, **settings), capture, fit=True)


def without_drawing(monkeypatch) -> None:
    """As before a long recording; what is asked here is decided without."""
    monkeypatch.setattr(poses, "MOST_PIXELS", 0)


def noted_corrections(monkeypatch) -> list[BodyTrack]:
    """The motions that are corrected by drawing from here on."""
    noted: list[BodyTrack] = []
    real = poses.refine

    def refine(track: BodyTrack, *args, **options):
        noted.append(track)
        return real(track, *args, **options)

    monkeypatch.setattr(poses, "refine", refine)
    return noted


def test_exact_poses_stay_at_every_key(captures, caplog):
    exact = seen(captures[0])
    with caplog.at_level(logging.INFO):
        untouched = prepared(exact)
    assert "exact: not smoothed, corrected between keys only" in caplog.text
    assert untouched.correction is not None
    keys = untouched.track.times_us.tolist()
    torch.nn.init.normal_(untouched.correction.between.rotations)
    turns, shifts = untouched.correction.residual(keys)
    assert turns.abs().max() < 1e-5 and shifts.abs().max() < 1e-5
    assert np.array_equal(untouched.track.poses, load_body_track(exact).poses)
    assert prepared(exact, between=False).correction is None


def test_poses_that_err_are_smoothed_and_corrected_by_what_is_said_of_them(captures, caplog):
    exact, noisy = (load_body_track(capture).poses for capture in captures)
    with caplog.at_level(logging.INFO):
        found = prepared(seen(captures[1]))
    assert "(source: estimated) are taken as off by some 0.050 rad and 10 mm" in caplog.text
    assert "smoothed in time, corrected in training" in caplog.text
    assert np.abs(found.track.poses - exact).mean() < np.abs(noisy - exact).mean()
    believed = 0.05 * SHARES["fast"] ** 0.5
    moved = np.sqrt(np.square(found.track.poses - noisy).mean())
    assert 0 < moved < 1.2 * believed, "the noise is larger, but may be fast motion"
    assert float(found.correction.joint_rad.max()) == pytest.approx(0.05)
    assert not bool(found.correction.exact)
    off = prepared(seen(captures[1]), smooth="never", refine="never", between=False)
    assert off.correction is None
    assert np.array_equal(off.track.poses, noisy)


def test_a_joint_that_is_said_to_err_less_is_smoothed_by_less(captures):
    noisy = load_body_track(captures[1]).poses
    std = np.full(noisy.shape[:2], 0.05, np.float32)
    std[:, 1], std[:, 2] = 0.005, 0.0
    with_errors(captures[1].path, pose_std_rad=std)
    found = prepared(seen(load_capture(captures[1].path)), refine="never")
    moved = np.sqrt(np.square(found.track.poses - noisy).mean((0, 2)))
    assert 0 < moved[1] < 1.2 * 0.005 * SHARES["fast"] ** 0.5
    assert moved[2] < 1e-12
    assert np.delete(moved, [1, 2]).max() > 2 * moved[1]


def test_poses_that_were_corrected_when_found_are_not_drawn_again(captures, monkeypatch):
    for how in ("refine", "judge"):
        monkeypatch.setattr(poses, how, lambda *_, **__: pytest.fail("drawn again"))
    file = captures[1].path / "capture.json"
    document = json.loads(file.read_text())
    document.setdefault("provenance", {})["poses"] = {"refinement": {"taken": False}}
    file.write_text(json.dumps(document))
    found = prepared(seen(load_capture(file.parent)))
    assert found.correction is not None and not bool(found.correction.exact)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("source", ["exact", "markers", "estimated"])
def test_what_a_capture_says_of_its_poses_counts_whatever_their_curve(
    seed, source, tiny_capture, monkeypatch
):
    """Fast exact motions stay as they are, smooth ones that are estimated are corrected."""
    without_drawing(monkeypatch)
    frames = 40 if source == "exact" else 20  # fast ones need the keys
    path, rng = tiny_capture(frames=frames), np.random.default_rng(seed)
    count, *joints = load_capture(path).body_file.poses.shape
    cycles, jitter = (8.0, 0.01) if source == "exact" else (0.5, 0.0)
    phase = 2 * np.pi * (np.linspace(0, cycles, count)[:, None, None] + rng.random(joints))
    turns = 0.3 * np.sin(phase) + jitter * rng.normal(size=(count, *joints))
    with_errors(path, source=source, poses=turns.astype(np.float32))
    found = prepared(seen(path))
    assert np.array_equal(found.track.poses, load_body_track(load_capture(path)).poses)
    assert bool(found.correction.exact) == (source == "exact")


@pytest.mark.parametrize(
    ("gain", "gain_error", "coarse", "wrong"),
    [
        (0.5, 0.02, 0.5, True),
        (0.12, 0.02, 0.05, True),
        (0.08, 0.02, 0.08, False),
        (0.12, 0.02, 0.16, False),
        (0.5, np.inf, 0.5, False),
    ],
)
def test_poses_that_say_nothing_are_corrected_once_they_are_disproved(
    gain, gain_error, coarse, wrong, tiny_capture, monkeypatch
):
    """By what pictures of half the size do not exaggerate (a true jump has 0.12 after 0.16)."""
    path = tiny_capture("silent", frames=20)
    with_errors(path, source=False)
    capture = seen(path)
    keys, joints = load_body_track(capture).poses.shape[:2]
    told = PoseErrors("estimated", np.full((keys, joints), 0.07), np.full((keys, 3), 0.03))
    monkeypatch.setattr(
        poses, "judge", lambda *_, **__: Verdict(gain, gain_error, 1.0, coarse, told)
    )
    corrected = noted_corrections(monkeypatch)
    found = prepared(capture).correction
    assert bool(found.exact) == (not wrong)
    assert [track.errors for track in corrected] == ([told] if wrong else [])
    if corrected:
        assert float(found.joint_rad.max()) == pytest.approx(0.07)


def test_joints_whose_errors_nobody_told_are_smoothed_by_less(captures, monkeypatch):
    """The same poses and errors, once said by the capture and once found by pictures."""
    given, said = load_body_track(captures[1]), prepared(seen(captures[1]), refine="never").track
    with_errors(captures[1].path, source=False, pose_std_rad=None, transl_std_m=None)
    verdict, smoothed = Verdict(0.5, 0.01, 1.0, 0.5, given.errors), noted_corrections(monkeypatch)
    monkeypatch.setattr(poses, "judge", lambda *_, **__: verdict)
    prepared(seen(load_capture(captures[1].path)))
    by_joint = [
        np.sqrt(np.square(track.poses - given.poses).mean((0, 2))) for track in (said, *smoothed)
    ]
    assert (by_joint[0] > by_joint[1]).all() and (by_joint[1] > 0).all()
    assert np.array_equal(said.transl, smoothed[0].transl)


@pytest.mark.parametrize(("said", "largest"), [(0.02, 0.02), (0.05, 0.05), (0.2, 0.05)])
def test_steps_of_large_errors_are_no_larger_than_those_of_poses_nobody_knows(
    said, largest, captures, monkeypatch
):
    """A first step of Adam is the learning rate, in units of the error that is expected."""
    without_drawing(monkeypatch)
    path = captures[1].path
    with np.load(path / "body.npz") as archive:
        std = np.full_like(archive["pose_std_rad"], said)
    with_errors(path, pose_std_rad=std)
    composition = composed(load_capture(path), "pose.smooth=never")
    errors = list(composition.model.residual.errors.parameters())
    (network,) = [one for one in composition.learning.networks if one.parameters[0] is errors[0]]
    usual = ERRORS_RATE * EvsplatConfig().rates.pose
    assert network.rate.start * said == pytest.approx(usual * largest)
    # Where limbs may be that much farther off, the shape changes by that much more.
    deformation = composition.model.deformation
    assert deformation.unit_m * largest == pytest.approx(0.01 * said)
    assert deformation.handles.shape[1] * largest == pytest.approx(100 * said)


def test_a_long_recording_is_not_drawn_before_training(captures, monkeypatch, caplog):
    capture = seen(captures[1])
    frames = len(capture.train_frames)
    monkeypatch.setattr(poses, "MOST_PIXELS", 3 * 32 * 24 * frames - 1)
    monkeypatch.setattr(poses, "refine", lambda *_, **__: pytest.fail("drawn"))
    found = prepared(capture).correction
    assert f"more than the {frames - 1} of this size" in caplog.text
    assert not bool(found.exact) and not bool(found.started)
    monkeypatch.setattr(poses, "MOST_PIXELS", 3 * 32 * 24 * frames)
    with pytest.raises(pytest.fail.Exception, match="drawn"):
        prepared(capture)


def test_what_was_found_out_is_part_of_the_state(captures, tiny_capture):
    """Of poses that say nothing: built to be loaded, the state decides."""
    path = tiny_capture("silent", frames=20)
    with_errors(path, source=False)
    given = prepare_poses(EvsplatConfig().pose, seen(path), fit=False).correction
    torch.nn.init.normal_(given.errors["fast"].rotations)
    state = given.state_dict()
    other = prepare_poses(EvsplatConfig().pose, seen(path), fit=False).correction
    other.load_state_dict(state | {"exact": torch.tensor(False)})
    assert other.residual([0])[0].abs().max() > 0
    other.load_state_dict(state | {"exact": torch.tensor(True)})
    assert other.residual([0])[0].abs().max() < 1e-6


def test_a_shape_that_changes_is_there_only_where_poses_may_err(captures, tiny_capture):
    path = tiny_capture("silent", frames=20)
    with_errors(path, source=False)
    exact, noisy = (composed(capture) for capture in captures)
    silent = built("evsplat", load_capture(path), *SETTINGS, purpose="draw")
    assert exact.model.deformation is None and exact.watched
    assert noisy.model.shape_changes is noisy.model.deformation is not None
    assert not noisy.watched  # nor does such a training end by itself
    prior = DeformationPrior()
    for given, names in ((False, {"deformation"}), (True, set())):
        silent.model.residual.exact.fill_(given)
        assert set(prior.loss(SimpleNamespace(model=silent.model))) == names
    kinds = [any(isinstance(o, DeformationPrior) for o in c.objectives) for c in (exact, silent)]
    assert kinds == [False, True]


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
    parts = [f"residual.{part}" for part in ("errors.constant", "errors.slow", "errors.fast")]
    kinds = ("rotations", "translations")
    between = {f"residual.between.{kind}" for kind in kinds}  # of the joints that errors leave some
    assert changed & between
    assert changed - between == {f"{part}.{kind}" for part in parts for kind in kinds}
    assert torch.equal(count, trainer.statistics["gaussians"].seen)


def test_without_being_asked_held_out_events_teach_nothing(captures, tmp_path, monkeypatch):
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
    assert ours["residual.errors.fast.rotations"].abs().max() > 0
    assert all(torch.equal(value, theirs[name]) for name, value in ours.items())
    # where they are asked for they do teach
    without_drawing(monkeypatch)
    asked = [learned(capture, *INTERPOLATION) for capture in (noisy, load_capture(others))]
    assert not torch.equal(*(each["residual.errors.fast.rotations"] for each in asked))


def test_events_of_held_out_frames_need_a_policy_that_shows_them(captures, monkeypatch):
    without_drawing(monkeypatch)
    with pytest.raises(ConfigError, match="policy.held_out_events=true as well"):
        composed(captures[1], "pose.events_of_held_out=true")


def test_events_of_held_out_frames_need_a_pose_that_is_learned(captures):
    with pytest.raises(ConfigError, match="events_of_held_out is true, and nothing reads it"):
        composed(captures[0], *INTERPOLATION, "pose.between=false")


@pytest.mark.parametrize("setting", ["pose.std_rad=0.1", "pose.std_m=0.1"])
def test_errors_expected_of_exact_poses_are_refused(captures, monkeypatch, setting):
    without_drawing(monkeypatch)
    exact, noisy = captures
    name = setting.partition("=")[0]
    with pytest.raises(ConfigError, match=f"{name} is 0.1, and nothing reads it: .* as exact"):
        composed(exact, setting)
    correction = composed(noisy, setting).model.residual
    found = correction.joint_rad if name == "pose.std_rad" else correction.root_m
    assert float(found.max()) == pytest.approx(0.1)


def test_a_correction_is_learned_where_it_is_asked_for(captures, monkeypatch):
    without_drawing(monkeypatch)
    composition = composed(captures[1])
    assert composition.held_out is None
    assert composition.model.residual is not None
    assert composition.weights["pose_prior"] == EvsplatConfig().pose.prior
    assert composed(captures[0], "pose.between=false").model.residual is None


def test_an_unknown_choice_is_named():
    with pytest.raises(ConfigError, match="pose.smooth"):
        small_config("evsplat", "pose.smooth=sometimes")
