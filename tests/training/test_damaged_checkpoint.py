"""Checkpoints that were changed by hand: refused in one sentence, nothing is written."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor

from evsplat.errors import DataError
from evsplat.training import load_run, train

from ..conftest import write_tiny_capture
from ..small_model import FILL, few_descent_steps, small

ROWS = "model.gaussians"


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of poses that err, so that shape changes in time as well, beside its capture."""
    place = tmp_path_factory.mktemp("damaged")
    write_tiny_capture(place / "capture")
    document = json.loads((place / "capture" / "capture.json").read_text())
    document["body"]["source"] = "estimated"
    (place / "capture" / "capture.json").write_text(json.dumps(document))
    with pytest.MonkeyPatch.context() as patch:
        few_descent_steps(patch)
        _train(place, place / "run", overrides=small("evsplat", FILL), iterations=4)
    return place


def _train(place: Path, run: Path, **options) -> None:
    train(place / "capture", out=run, any_body=True, threads=1, **options)


def damaged(place: Path, run: Path, change: Callable[[dict[str, Tensor], dict], object]) -> Path:
    """A copy of the run whose checkpoint's tensors and state were changed in place."""
    shutil.copytree(place / "run", run)
    (file,) = (run / "checkpoints").iterdir()
    with safe_open(file, "pt") as opened:
        state = json.loads(opened.metadata()["state"])
    tensors = load_file(file)
    change(tensors, state)
    contiguous = {name: value.contiguous() for name, value in tensors.items()}
    save_file(contiguous, file, {"state": json.dumps(state)})
    return run


def tensor(name: str, change: Callable[[Tensor], Tensor]):
    """Change of one tensor."""
    return lambda tensors, state: tensors.update({name: change(tensors[name])})


def clock(**values: float):
    """Change of the clock."""
    return lambda tensors, state: state["clock"].update(values)


DRAWN = {
    "gaussians.means holds": tensor(f"{ROWS}.means", lambda v: v * torch.nan),
    "gaussians.scales_log has shape": tensor(f"{ROWS}.scales_log", lambda v: v[:20]),
    "gaussians.colour_logits has shape": tensor("filled.gaussians.colour_logits", lambda v: v[:20]),
    "deformation.handles holds": tensor("model.deformation.handles", lambda v: v + torch.inf),
    "deformation.handles": tensor("model.deformation.handles", lambda v: v[:, :50]),
    "what was seen holds": tensor("seen.weight", lambda v: v * torch.nan),
    "a solid scene holds": tensor("solid.scales", lambda v: v * torch.nan),
    "a solid scene is of shapes": tensor("solid.rgb", lambda v: v[:20]),
    "'opacities'": lambda tensors, state: tensors.pop("solid.opacities"),
    "Gaussians of the person": lambda tensors, state: state.update(human_count=10**9),
}
RESUMED = {
    "gaussians.means holds": DRAWN["gaussians.means holds"],
    "optimiser.networks.0 has moments": tensor("optimiser.networks.0.exp_avg", lambda v: v[:1]),
    "optimiser.gaussians.0 has moments": tensor(
        "optimiser.gaussians.0.exp_avg_sq", lambda v: v[:1]
    ),
    "exp_avg": lambda tensors, state: tensors.pop("optimiser.networks.0.exp_avg"),
    "optimiser.networks.0.exp_avg holds": tensor(
        "optimiser.networks.0.exp_avg", lambda v: v * torch.nan
    ),
    "statistics.gaussians.seen has shape": tensor("statistics.gaussians.seen", lambda v: v[:5]),
    "surface.index holds": tensor("surface.index", lambda v: torch.full((150,), 10**9)),
    "surface.index holds others": tensor("surface.index", lambda v: torch.full((150,), -1)),
    r"queue\[0\] is 3000": lambda tensors, state: state.update(queue=[3000]),
    r"queue\[1\] is -1": lambda tensors, state: state.update(queue=[0, -1]),
    "iteration is -3": clock(iteration=-3),
    "iterations is 0": clock(iterations=0),
    "ends_at is -4": clock(ends_at=-4),
    "fraction is 2": clock(fraction=2.0),
    "step_seconds is -1": clock(step_seconds=-1.0),
}


@pytest.mark.parametrize("said", DRAWN)
def test_what_is_not_the_model_s_is_not_drawn(trained: Path, tmp_path: Path, said: str) -> None:
    run = damaged(trained, tmp_path / "run", DRAWN[said])
    with pytest.raises(DataError, match=f"000004.safetensors: does not fit .*({said})"):
        load_run(run)


@pytest.mark.parametrize("name", ["shade.network.biases.2", "relief.coarse"])
def test_numbers_that_overflow_in_the_picture_are_told(
    trained: Path, tmp_path: Path, name: str
) -> None:
    enormous = tensor(f"model.{name}", lambda v: torch.full_like(v, 1e9))
    run = load_run(damaged(trained, tmp_path / "run", enormous))
    with pytest.raises(DataError, match="draws numbers that are not finite .* checkpoint"):
        run.reconstruction.render(run.capture.camera("0000"), [15_000])


@pytest.mark.parametrize("said", RESUMED)
def test_what_is_not_the_training_s_is_not_gone_on_from(
    trained: Path, tmp_path: Path, said: str
) -> None:
    run = damaged(trained, tmp_path / "run", RESUMED[said])
    before = sorted(path for path in run.rglob("*") if path.is_file())
    with pytest.raises(DataError, match=f"000004.safetensors: does not fit .*({said})"):
        _train(trained, run, resume=True, iterations=6)
    assert sorted(path for path in run.rglob("*") if path.is_file()) == before


def test_a_capture_that_was_moved_is_found_where_the_run_is_told(
    trained: Path, tmp_path: Path
) -> None:
    run = damaged(trained, tmp_path / "run", lambda tensors, state: None)
    facts = json.loads((run / "versions.json").read_text())
    (run / "versions.json").write_text(json.dumps(facts | {"capture": str(tmp_path / "gone")}))
    with pytest.raises(DataError, match="gone: not found, expected the capture that .*put it back"):
        load_run(run)
    (run / "versions.json").write_text(json.dumps(facts | {"capture": 5_000 * "x"}))
    with pytest.raises(DataError, match="x: not found, expected the capture that"):
        load_run(run)
    (run / "versions.json").write_text(json.dumps(facts))
    assert load_run(run).iteration == 4


def test_the_same_run_untouched_goes_on(trained: Path, tmp_path: Path) -> None:
    run = damaged(trained, tmp_path / "run", lambda tensors, state: None)
    assert load_run(run).iteration == 4
    _train(trained, run, resume=True, iterations=6)
    assert load_run(run).iteration == 6
