"""What a finished training made transparent is in its checkpoint, and in nothing made of it."""

import shutil

import pytest
import torch

from evsplat.capture import load_capture
from evsplat.export import export_run
from evsplat.training.checkpoint import load_checkpoint, load_latest, load_model, write_state
from evsplat.training.run import load_run, reload_run
from evsplat.training.train import train

from ..conftest import write_tiny_capture
from ..small_model import FILL, small

GONE = (0, 3, 7)
"""Rows that the end of training makes transparent."""
ROUNDING = 2.0**-23
"""Of values up to 1. PyTorch computes the last rows of a tensor, which fill no vector, by other
code; which rows those are depends on how many there are."""
OPACITIES = "filled.gaussians.opacity_logits"


@pytest.fixture(scope="module")
def thinned_once(tmp_path_factory):
    """A run whose end made some Gaussians transparent."""
    place = tmp_path_factory.mktemp("thinned")
    capture = write_tiny_capture(place / "tiny")
    run = train(capture, out=place / "run", iterations=3, overrides=small("evsplat", FILL))
    path, tensors, state = load_latest(run / "checkpoints")
    tensors[OPACITIES].clamp_(min=-2.0)
    tensors[OPACITIES][list(GONE)] = -14.0
    write_state(path, tensors, state)
    return run


@pytest.fixture
def thinned(thinned_once, tmp_path):
    """A copy of it that may be spoilt, and its checkpoint."""
    run = shutil.copytree(thinned_once, tmp_path / "run")
    return run, load_latest(run / "checkpoints")[0]


def test_pictures_without_transparent_rows_are_the_same_but_for_rounding(thinned):
    path, checkpoint = thinned
    tensors, state = load_checkpoint(checkpoint)
    run, whole = load_run(path), load_run(path).reconstruction
    load_model(whole.model, tensors, state["human_count"], filled=True)
    rows, less = whole.model.gaussians, run.reconstruction.model.gaussians
    kept = torch.ones(len(rows), dtype=torch.bool)
    kept[list(GONE)] = False
    assert less.human_count == state["human_count"] - len(GONE) == run.gaussians["human"]
    for name in rows.attributes:
        assert torch.equal(less.get_parameter(name), rows.get_parameter(name)[kept])
    for name, value in vars(run.reconstruction.seen).items():
        assert torch.equal(value, tensors[f"seen.{name}"][kept[rows.human]])
    for frame in run.capture.frames[:2]:
        camera = run.capture.camera(frame)
        pictures = [of.render(camera, [frame.mid_us]) for of in (whole, run.reconstruction)]
        for name in ("rgb", "alpha", "human"):
            one, other = (getattr(picture, name) for picture in pictures)
            assert float((one - other).abs().max()) <= ROUNDING, name


def test_opaque_enough_for_one_pixel_stays_and_so_does_the_scene(thinned):
    path, checkpoint = thinned
    tensors, state = load_checkpoint(checkpoint)
    opacities = torch.tensor([0.9 / 255, 1.1 / 255])
    tensors[OPACITIES][list(GONE)] = 2.0
    tensors[OPACITIES][:2] = opacities.logit()
    tensors[OPACITIES][-1] = -14.0
    write_state(checkpoint, tensors, state)
    run = load_run(path)
    assert run.gaussians["human"] == state["human_count"] - 1
    assert len(run.reconstruction.model.gaussians) == len(tensors[OPACITIES]) - 1


def test_files_hold_what_can_be_seen_and_training_goes_on_with_all(thinned):
    path, checkpoint = thinned
    count = load_checkpoint(checkpoint)[1]["human_count"]
    ply = export_run(path, "ply", parts="human")
    header = ply.read_bytes()[:2000].decode("latin-1")
    assert f"element vertex {count - len(GONE)}\n" in header
    capture = load_capture(load_run(path).capture.path)
    train(capture.path, out=path, iterations=5, resume=True)
    tensors, state = load_latest(path / "checkpoints")[1:]
    assert state["clock"]["iteration"] == 5 and state["human_count"] == count
    assert len(tensors["seen.weight"]) == count


def test_a_run_goes_to_a_checkpoint_of_before_the_end_and_back(thinned, tmp_path):
    path, checkpoint = thinned
    tensors, state = load_checkpoint(checkpoint)
    before = tmp_path / "before.safetensors"
    write_state(before, {k: v for k, v in tensors.items() if k.startswith("model.")}, state)
    run = load_run(path)
    run = reload_run(run, before)
    assert run.gaussians["human"] == state["human_count"] and run.reconstruction.seen is None
    run = reload_run(run, checkpoint)
    assert run.gaussians["human"] == state["human_count"] - len(GONE)
    assert len(run.reconstruction.certainties()) == run.gaussians["human"]
