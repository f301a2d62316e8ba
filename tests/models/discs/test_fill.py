"""What the end of training decides where little was seen; pictures and learned values stay."""

import copy
import math
from types import SimpleNamespace

import pytest
import torch

from evsplat.capture import Policy, load_capture
from evsplat.errors import DataError
from evsplat.film.looks import Look
from evsplat.models.discs.fill import _beyond_shade, _Pictures, _shade, _views, filled
from evsplat.models.discs.transparent import OFF_FROM_M, off_the_body
from evsplat.models.drawing import draw
from evsplat.models.seen import Seen, seen_by
from evsplat.training.checkpoint import below, load_latest, load_model, write_state
from evsplat.training.run import load_run
from evsplat.training.train import train

from ...conftest import write_tiny_capture
from ...small_model import FILL, built, small


@pytest.fixture(scope="module")
def spoilt_once(tmp_path_factory):
    whole = load_capture(write_tiny_capture(tmp_path_factory.mktemp("spoilt") / "tiny"))
    capture = whole.for_training(Policy())
    model = built("evsplat", whole).model
    generator = torch.Generator().manual_seed(0)
    gaussians = model.gaussians
    seen = seen_by(model, capture)
    with torch.no_grad():
        colours = gaussians.get_parameter(gaussians.colour)
        colours.fill_(0.5)
        noise = 2 * torch.randn(gaussians.human_count, 3, generator=generator)
        colours[gaussians.human][seen.little()] += noise[seen.little()]
        model.shading.coefficients.normal_(0, 0.02, generator=generator)
    return model, capture, seen


@pytest.fixture
def spoilt(spoilt_once):
    """A model with light whose unseen colours are noise, what it saw, and its capture."""
    model, capture, seen = spoilt_once
    return copy.deepcopy(model), capture, seen


@torch.no_grad()
def frames_of(model, capture):
    cameras = [capture.camera(frame) for frame in capture.train_frames]
    times = [frame.mid_us for frame in capture.train_frames]
    return [
        (model.at([time], camera.center(), hard_semantics=True), camera)
        for time, camera in zip(times, cameras, strict=True)
    ]


def test_light_is_linear_in_its_terms(spoilt):
    model, capture, _ = spoilt
    frame = capture.train_frames[1]
    layers = model.at([frame.mid_us], capture.camera(frame).center(), hard_semantics=True)
    terms, factors = model.light_terms(layers, frame.mid_us)
    shading = model.shading
    numbers = torch.cat([shading.coefficients.flatten(0, 1), shading.intensities])
    assert torch.allclose(1 + terms @ numbers, factors, atol=1e-5)
    colours = model.gaussians.get_parameter(model.gaussians.colour)[model.gaussians.human].sigmoid()
    assert torch.allclose(layers.human.channels[..., :3], colours * factors, atol=1e-5)


def test_the_fill_evens_what_is_unseen_and_leaves_the_pictures(spoilt):
    model, capture, seen = spoilt
    before = copy.deepcopy(model.state_dict())
    found = filled(model, capture, 0.005, seen)
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())
    new = copy.deepcopy(model)
    new.load_state_dict({**before, **found})
    rows = model.gaussians.human
    name = f"gaussians.{model.gaussians.colour}"
    assert torch.equal(found[name][rows.stop :], before[name][rows.stop :])
    never = seen.squares <= seen.squares.quantile(0.1)
    assert float(found[name][rows][never].std()) < 0.3 * float(before[name][rows][never].std())
    for (old, camera), (layers, _) in zip(
        frames_of(model, capture), frames_of(new, capture), strict=True
    ):
        with torch.no_grad():
            change = (draw(layers, camera).output.image - draw(old, camera).output.image)[..., :3]
        assert float(change.square().mean().sqrt()) < 0.01


def test_discs_off_the_body_that_no_picture_misses_become_transparent(spoilt):
    model, capture, seen = spoilt
    rows = model.gaussians.human
    normals = model.surface.normals(model.gaussians.means[rows])
    unseen = seen.squares.argsort()[:5]
    with torch.no_grad():
        model.gaussians.means[rows][unseen] += 0.05 * normals[unseen]
    seen = seen_by(model, capture)
    before = model.gaussians.opacity_logits.detach().clone()
    found = filled(model, capture, 0.005, seen)["gaussians.opacity_logits"]
    assert torch.equal(found[rows.stop :], before[rows.stop :])
    assert bool((found <= before).all())
    still = seen.squares[unseen] < 1e-4
    assert bool(still.any())
    assert float(found[rows][unseen][still].sigmoid().max()) < 0.1
    facing = (seen.directions * normals).sum(-1) > 0
    off = off_the_body(model.gaussians.means[rows], normals, model.surface)
    stays = facing & (off < OFF_FROM_M)
    assert torch.equal(found[rows][stays], before[rows][stays])


def test_what_was_well_seen_keeps_its_look_in_a_light_twice_as_bright(spoilt):
    model, capture, seen = spoilt
    rows, name = model.gaussians.human, model.gaussians.colour
    with torch.no_grad():
        model.shading.coefficients.zero_()
        normals = model.surface.normals(model.gaussians.means[rows])
        own = model.gaussians.get_parameter(name)[rows, :3].sigmoid()
    views = _views(model, capture, normals)
    with torch.no_grad():
        model.shading.coefficients[0, 0] = 1.0  # of the constant term: the factor is 2
    relit = _Pictures.of(model, views, own).relit(own)
    well = ~seen.little()
    assert torch.allclose(relit[well], own[well] / 2, rtol=1e-3)
    never = torch.stack([view.weight for view in views]).sum(0) == 0
    assert torch.equal(relit[never], own[never])


def test_the_shade_is_the_darkest_fifth_in_the_mean_light_s_hue():
    factors = torch.linspace(0.5, 1.5, 11, dtype=torch.float64)[:, None].expand(11, 3)
    tint = torch.tensor([1.2, 1.0, 0.8], dtype=torch.float64)
    shade = _shade(factors * tint, torch.ones(11, dtype=torch.float64))
    assert torch.allclose(shade, 0.7 * tint)


def hang_lamp(model, way, share, distance_m=150.0):
    """The first lamp in a direction, its shadow taking a share; no shadow of the others."""
    with torch.no_grad():
        model.lamps.directions[0] = way
        model.lamps.distances_log.fill_(math.log(distance_m))
        model.shadow.share_logits.fill_(-4.0)
        model.shadow.share_logits[0] = torch.tensor(share).logit()


def test_a_lamp_brightens_what_faces_it_as_its_shadow_darkens_the_floor(spoilt):
    model = spoilt[0]
    up = model.lamps.up
    side = torch.linalg.cross(up, torch.tensor([0.3, 0.5, 0.8]))
    side = side / side.norm()
    hang_lamp(model, 0.8 * side + 0.6 * up, 0.3)
    normals = torch.stack([up, side, -side, 0.8 * side + 0.6 * up])[None]
    places = model.lamps.center.expand(1, 4, 3)
    terms = model.surface_light().shading.terms(normals, places, model.lamps.places())[0]
    behind = model.lamps.center - side
    brighter = _beyond_shade(model, terms, 0.0, behind)
    # the floor is 1 / (1 - 0.3) times as bright in the light as in the shade; linear light adds up
    lit = 0.7**-2.2 - 1
    expected = [1 + lit, 1 + lit * 0.8 / 0.6, 1, 1 + lit / 0.6]
    assert brighter.tolist() == pytest.approx([value ** (1 / 2.2) for value in expected], rel=1e-3)
    beside = model.lamps.center + side  # a camera that sees what that lamp does
    assert torch.equal(_beyond_shade(model, terms, 0.0, beside), torch.ones(4))
    hang_lamp(model, 0.8 * side + 0.6 * up, 0.1)
    assert torch.equal(_beyond_shade(model, terms, 0.0, behind), torch.ones(4))


def test_a_lamp_nearby_gives_the_person_more_than_the_floor_behind(spoilt):
    model = spoilt[0]
    lamps, up = model.lamps, model.lamps.up
    side = torch.linalg.cross(up, torch.tensor([0.3, 0.5, 0.8]))
    way = 0.6 * side / side.norm() + 0.8 * up
    hang_lamp(model, way, 0.2, distance_m=2.0)
    terms = model.surface_light().shading.terms(
        way[None, None], lamps.center[None, None], lamps.places()
    )[0]
    # light over the floor 1 m below, where the lamp's ray through the middle meets it
    floor = lamps.center - way / 0.8
    apart = lamps.places()[0] - floor
    on_floor = float((apart @ up / apart.norm() ** 3).detach())
    lit = (0.8**-2.2 - 1) * (1 / 2.0**2) / on_floor
    found = float(_beyond_shade(model, terms, 1.0, lamps.center - way).detach())
    assert found == pytest.approx((1 + lit) ** (1 / 2.2), rel=1e-4)


def test_a_lamp_behind_the_person_lights_the_back_that_nobody_saw(spoilt):
    model, capture, seen = spoilt
    camera = capture.camera(capture.train_frames[0])
    to_camera = camera.center() - model.lamps.center
    level = to_camera - (to_camera @ model.lamps.up) * model.lamps.up
    level = level / level.norm()
    with torch.no_grad():
        model.shading.coefficients.zero_()
    (layers, _), *_ = frames_of(model, capture)
    mid = capture.train_frames[0].mid_us
    normals = model.surface.normals(model.gaussians.means[model.gaussians.human])
    turned = (layers.transforms[0, :, :3, :3] @ normals[..., None])[..., 0]
    behind = turned @ level < -0.7
    bright = {}
    for name, way in (("before", level), ("behind", -level)):
        hang_lamp(model, way + model.lamps.up, 0.4)
        new = copy.deepcopy(model)
        new.load_state_dict({**model.state_dict(), **filled(model, capture, 0.005, seen)})
        with torch.no_grad():
            bright[name] = new.light_terms(layers, mid)[1][0][behind].mean()
    assert bool(behind.any())
    assert bright["before"] == pytest.approx(1, abs=0.1)
    # as far as what shines through the front, in the light of the front, lets it
    assert bright["behind"] > bright["before"] + 0.02


def test_nothing_is_decided_where_nobody_was_seen(spoilt):
    model, capture, seen = spoilt
    nothing = Seen(*(torch.zeros_like(value) for value in vars(seen).values()))
    assert filled(model, capture, 0.005, nothing) == {}


@pytest.mark.parametrize(
    "settings",
    [
        ("lamps=0",),
        ("shading=false", "lamps=2"),
        ("scene.kind=random_cube", "scene.cube_count=300"),
    ],
)
def test_every_kind_of_model_is_filled(tiny_capture, settings):
    capture = load_capture(tiny_capture())
    model = built("evsplat", capture, *settings).model
    training = capture.for_training(Policy())
    found = filled(model, training, 0.0025, seen_by(model, training))
    state = model.state_dict()
    assert f"gaussians.{model.gaussians.colour}" in found
    assert all(value.shape == state[name].shape for name, value in found.items())
    assert all(bool(value.isfinite().all()) for value in found.values())


def test_of_many_frames_some_stand_for_all(spoilt, monkeypatch):
    model, capture, _ = spoilt
    frame, looked = capture.train_frames[0], []

    def camera(frame):
        looked.append(frame)
        return capture.camera(frame)

    def seen_of(count):
        looked.clear()
        return seen_by(model, SimpleNamespace(train_frames=(frame,) * count, camera=camera))

    one = seen_of(1)
    monkeypatch.setattr("evsplat.models.seen.MOST_FRAMES", 2)
    seven = seen_of(7)
    assert len(looked) == 2
    torch.testing.assert_close(seven.weight, 7 * one.weight)
    torch.testing.assert_close(seven.directions, 7 * one.directions)
    assert float(seven.squares.sum()) == pytest.approx(7 * float(one.squares.sum()), rel=0.2)


def test_a_run_is_drawn_filled_and_goes_on_unfilled(tiny_capture, tmp_path):
    capture = tiny_capture()
    run = train(capture, out=tmp_path / "run", iterations=3, overrides=small("evsplat", FILL))
    bare = train(capture, out=tmp_path / "bare", iterations=3, overrides=small("evsplat"))
    states = [load_latest(path / "checkpoints") for path in (run, bare)]
    (_, tensors, state), (_, others, _) = states
    assert below("filled", tensors) and not below("filled", others) and below("seen", others)
    model, other = below("model", tensors), below("model", others)
    assert all(torch.equal(model[name], other[name]) for name in model)
    assert below("solid", tensors) and not below("solid", others)
    drawn = load_run(run).reconstruction
    assert drawn.seen is not None and load_run(bare).reconstruction.solid is None
    assert len(drawn.seen.weight) == drawn.model.gaussians.human_count <= state["human_count"]
    colour = drawn.model.gaussians.colour
    frame = load_capture(capture).frames[0]
    camera = load_capture(capture).camera(frame)
    through = [
        1 - float(each.render(camera, [frame.mid_us], parts="scene").alpha.mean())
        for each in (drawn, drawn.elsewhere(), drawn.following(drawn.track).elsewhere())
    ]
    assert through[1] < 0.5 * through[0] and through[2] == through[1]
    certain = drawn.certainty(camera, [frame.mid_us], parts="human")[0]
    assert 0 < float(certain.max()) <= 1
    shown = Look("certainty").expose(drawn, camera, [frame.mid_us])[0]
    assert shown.shape == (camera.height, camera.width, 3)
    kept = {name: value for name, value in tensors.items() if name.startswith("model.")}
    write_state(tmp_path / "older.safetensors", kept, state)
    older = load_run(run, state=tmp_path / "older.safetensors")
    assert older.what_was_seen() is None
    with pytest.raises(DataError, match="does not say what training saw.*--resume"):
        Look("certainty").expose(older.reconstruction, camera, [frame.mid_us])
    learned = copy.deepcopy(drawn.model)
    load_model(learned, tensors, state["human_count"])
    assert not torch.equal(
        drawn.model.gaussians.get_parameter(colour), learned.gaussians.get_parameter(colour)
    )
    assert torch.equal(learned.gaussians.get_parameter(colour), model[f"gaussians.{colour}"])


@pytest.fixture
def parts_at(spoilt, monkeypatch):
    """Brightness and hue of the little seen, and colours of the rest, after a fill at prices."""
    model, capture, seen = spoilt
    rows, name = model.gaussians.human, f"gaussians.{model.gaussians.colour}"
    little = seen.little()

    def parts(**prices):
        for price, value in prices.items():
            monkeypatch.setattr(f"evsplat.models.discs.fill.{price}", value)
        colours = filled(model, capture, 0.001, seen)[name][rows].sigmoid()
        bright = colours.mean(-1, keepdim=True)
        return bright[little], (colours - bright)[little], colours[~little]

    return parts


def test_hues_that_the_pictures_hardly_tell_are_calm_and_brightness_stays(parts_at):
    bright, hues, front = parts_at(HUE=0.0, BRIGHT=0.0)
    as_bright, calmer, same_front = parts_at(HUE=30.0, BRIGHT=0.0)
    assert float(calmer.square().mean()) < 0.5 * float(hues.square().mean())
    assert float(as_bright.std()) > 0.7 * float(bright.std())
    assert float((same_front - front).square().mean().sqrt()) < 0.02


def test_brightness_that_the_pictures_hardly_tell_is_calm_and_hues_stay(parts_at):
    bright, hues, front = parts_at(HUE=0.0, BRIGHT=0.0)
    calmer, as_hued, same_front = parts_at(HUE=0.0, BRIGHT=30.0)
    assert float(calmer.std()) < 0.7 * float(bright.std())
    assert float(as_hued.square().mean()) > 0.7 * float(hues.square().mean())
    assert float((same_front - front).square().mean().sqrt()) < 0.02
