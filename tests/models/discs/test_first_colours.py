"""Colours of the person before the first step, from pictures of someone whose colours are known."""

from types import SimpleNamespace

import pytest
import torch

from evsplat.capture import load_capture
from evsplat.models.discs.first_colours import first_colours
from evsplat.models.seen import draw_values, seen_by

from ...small_model import built


@pytest.fixture
def painted(tiny_capture):
    """A model, and a capture whose pictures show it in the colours that a function paints."""

    def made(paint, scene=None):
        capture = load_capture(tiny_capture())
        model = built("evsplat", capture, "human.count=800").model
        colours = paint(model.gaussians.means[model.gaussians.human].detach())

        def image(frame):
            camera = capture.camera(frame)
            with torch.no_grad():
                layers = model.at([frame.mid_us], camera.center(), hard_semantics=True)
                behind = layers.scene.channels[..., :3] if scene is None else scene
                behind = behind.expand_as(layers.scene.channels[..., :3])
                return draw_values(layers, camera, colours[None], behind)[0]

        shown = SimpleNamespace(
            train_frames=capture.train_frames, camera=capture.camera, image=image
        )
        return model, shown, colours

    return made


def test_one_colour_before_the_same_is_found_everywhere(painted):
    grey = torch.tensor([0.2, 0.5, 0.7])
    model, capture, colours = painted(lambda means: grey.expand(len(means), 3), scene=grey)
    found = first_colours(model, capture).sigmoid()
    # Where no Gaussian is, the picture is black: none of the person's lies there.
    assert float((found - colours).abs().max()) < 0.02


@pytest.mark.parametrize("seed", range(4))
def test_what_is_seen_gets_nearly_its_colour_and_the_rest_what_neighbours_have(painted, seed):
    axis = torch.randn(3, 3, generator=torch.Generator().manual_seed(seed))
    model, capture, colours = painted(lambda means: (means @ axis).sin() * 0.4 + 0.5)
    found = first_colours(model, capture).sigmoid()
    seen = seen_by(model, capture)
    well = seen.squares > seen.squares.quantile(0.9)
    middle = colours.mean(0)
    error = (found - colours).square().mean(-1)
    before = (middle - colours).square().mean(-1)
    # Not the mean: what lies at the outline shares its pixels with the scene.
    assert float(error[well].median()) < 0.05 * float(before[well].median())
    pictures = torch.stack([capture.image(frame) for frame in capture.train_frames])
    assert float(found.min()) > float(pictures.min()) - 0.01
    assert float(found.max()) < float(pictures.max()) + 0.01


@pytest.mark.parametrize("settings", [(), ("scene.kind=random_cube", "scene.cube_count=300")])
def test_training_starts_at_them_and_a_run_that_goes_on_does_not(tiny_capture, settings):
    capture = load_capture(tiny_capture())
    trained = built("evsplat", capture, *settings, purpose="train").model.gaussians
    resumed = built("evsplat", capture, *settings).model.gaussians
    untold = resumed.get_parameter(resumed.colour).detach()
    colours = trained.get_parameter(trained.colour).detach()
    assert float(colours[trained.human, :3].std()) > 0.1
    assert float(untold[resumed.human, :3].abs().max()) == 0
    assert float(colours[trained.human, 3:].abs().sum()) == 0
