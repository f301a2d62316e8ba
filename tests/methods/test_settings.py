"""Settings of the methods: what nothing reads, what is out of range, what earlier versions had."""

import json
from typing import Any

import numpy as np
import pytest

from evsplat.capture import load_capture
from evsplat.config import override, settings
from evsplat.errors import ConfigError
from evsplat.methods import TRAINABLE, method_config

from ..small_model import built, small

PERSON = [("human.count=100", "human.count=null", "human.spacing_px=9")]
SCENE = [
    (
        "scene.kind=median_backdrop",
        "scene.kind=random_cube",
        "scene.cube_count=9 scene.cube_half_side_m=9 scene.cube_max_count=9",
    ),
    ("scene.kind=random_cube", "scene.kind=median_backdrop", "scene.backdrop_stride_px=9"),
]
FITTED = [("scene.kind=random_cube", "scene.kind=median_backdrop", "scene.prefit_steps=5")]
TERMS = [("terms.perceptual=none", "terms.perceptual=lpips_vgg", "terms.perceptual_weight=0.5")]
POSES = [("networks.pose_start=null", "networks.pose_start=9", "rates.pose=0.5")]
UNREAD = {
    "avatar3dgs": [*PERSON, *TERMS, *POSES],
    "avatar3dgs_semantic": [*PERSON, *SCENE, *TERMS, *POSES],
    "evsplat": [
        *PERSON,
        *SCENE,
        *FITTED,
        ("lamps=0", "lamps=2", "self_shadow=false rates.shadow=0.5"),
        ("shading=false", "shading=true", "self_shadow=false rates.shading=0.5"),
        ("most_renders=1", "most_renders=3", "px_per_render=9"),
        ("event_weight=0", "event_weight=1", "event_term=paper event_start=1000"),
        *(
            (
                closed,
                "event_weight=1",
                "event_eps=0.5 event_reach=9 event_ramp_us=9 event_hue_from=9 "
                "event_noise_aware=false contrast_weight=9 clock=always rates.sensor=0.5 "
                "pose.events_of_held_out=true",
            )
            for closed in ("event_weight=0", "event_term=paper")
        ),
        ("pose.refine=never", "pose.refine=auto", "pose.std_rad=0.1 pose.std_m=0.1"),
    ],
    "hugs": [
        *PERSON,
        *SCENE,
        ("perceptual=none", "perceptual=lpips_vgg", "perceptual_weight=0.5"),
    ],
    "paper": [
        *PERSON,
        *SCENE,
        *FITTED,
        *TERMS,
        *POSES,
        (
            "event_weight=0",
            "event_weight=1",
            "event_start=9 event_floor=0.5 event_eps=0.5 event_weight_by_activity=false "
            "event_min_active=0.5",
        ),
        *(
            (
                f"semantics={closed}",
                "semantics=rendered",
                "semantic_band_px_at_256=5 semantic_weight=0.5 binarise_weight=0.5",
            )
            for closed in ("fixed", "ste")
        ),
    ],
}
"""By method: a setting under which others are not read, one under which they are, the others."""


@pytest.mark.parametrize("method", TRAINABLE)
def test_settings_that_nothing_would_read_are_refused(method):
    for closed, opened, others in UNREAD[method]:
        for other in others.split():
            name, closes = other.partition("=")[0], closed.partition("=")[0]
            with pytest.raises(ConfigError) as error:
                method_config(method, override({}, (closed, other)), where="here")
            said = str(error.value)
            assert said.startswith(f"here: {name} is ") and "\n" not in said
            assert f"nothing reads it unless {closes} is " in said
            assert said.endswith(f"leave it out or set {closes}.")
            method_config(method, override({}, (opened, other)), where="here")


@pytest.mark.parametrize("method", TRAINABLE)
def test_every_condition_of_a_setting_is_tried(method):
    tried = {
        (other.partition("=")[0], closed.partition("=")[0])
        for closed, _, others in UNREAD[method]
        for other in others.split()
    }
    every = settings(TRAINABLE[method].config())
    assert tried == {(one.name, name) for one in every for name, _ in one.conditions}


OUT_OF_RANGE = {
    "avatar3dgs": "alpha_weight=-1 networks.pose_start=-1 terms.perceptual=vgg rates.constant=1",
    "avatar3dgs_semantic": "semantic_band_px_at_256=0 scene.kind=cube binarise_weight=[[0,-1]]",
    "evsplat": "low_pass=0.5 low_pass=0 lamps=17 lamps=-1 lamps=1.5 width=0 px_per_render=0 "
    "most_renders=0 event_start=-1 event_start=15001 event_weight=-0.1 event_weight=.inf "
    "event_term=none event_eps=0 event_reach=-1 event_ramp_us=-1 event_hue_from=-1 clock=maybe "
    "contrast_weight=-1 "
    "rates.final=0 rates.final=2 rates.means=-1 pose.std_rad=0 pose.start=15001 "
    "pose.prior=-1 pose_noise=-1 shade_start=.nan shading=1 semantic_band_px_at_256=0 "
    "scene.prefit_steps=-1 scene.backdrop_stride_px=0 scene.cube_count=3 scene.cube_half_side_m=0",
    "hugs": "channels=0 resolution=1 sh_degree=4 fit_steps=-1 rate_scale=0 skinning_weight=-1",
    "paper": "networks.width=0 networks.colour_width=0 networks.pose_noise=-1 semantics=soft "
    "scene_direction_dropout=1.5 terms.isometry_samples=0 terms.skinning_prefit_steps=-1 "
    "event_floor=-1 event_min_active=-1 terms.skinning=[[-1,1]] l1_weight=much",
}
EVERYWHERE = (
    "iterations=0 human.count=0 human.spacing_px=0 densify.start=-1 densify.end=15001 "
    "densify.gradient=0 densify.max_human=-1 l1_weight=-1 dssim_weight=-1 policy.masks=all"
)


@pytest.mark.parametrize("method", TRAINABLE)
def test_values_out_of_range_are_refused_in_one_sentence(method):
    for setting in f"{OUT_OF_RANGE[method]} {EVERYWHERE}".split():
        with pytest.raises(ConfigError) as error:
            method_config(method, override({}, (setting,)), where="here")
        said = str(error.value)
        assert said.startswith(f"here: {setting.partition('=')[0]} is "), setting
        assert "; expected " in said and said.endswith(".") and "\n" not in said


@pytest.mark.parametrize("method", ["avatar3dgs_semantic", "evsplat", "paper"])
@pytest.mark.parametrize("masks", ["given", "estimated"])
def test_masks_are_refused_by_methods_that_read_none(method, masks, tiny_capture):
    capture = load_capture(tiny_capture())
    with pytest.raises(ConfigError) as error:
        built(method, capture, f"policy.masks={masks}")
    assert str(error.value) == (
        f"policy.masks is {masks}, and method {method} reads no masks; leave it out."
    )


FORMER_BODY = (
    "human.max_count human.opacity human.width human.flatness optimisation.iterations "
    "optimisation.rates.constant optimisation.rates.scales_log densify_human.start "
    "densify_human.end densify_human.every densify_human.gradient densify_human.split_above_m "
    "densify_human.prune_opacity densify_human.prune_after densify_human.opacity_reset "
    "densify_human.max_count loss.l1 loss.dssim loss.skinning loss.perceptual "
    "loss.perceptual_weight"
)
FORMER_NETWORKS = (
    "deform.encoding deform.width deform.non_rigid_depth deform.non_rigid_last_std "
    "deform.skinning_depth deform.skinning deform.skinning_turns deform.skinning_grid "
    "deform.human_colour deform.colour_width deform.latent_dim deform.precision "
    "deform.non_rigid_start deform.pose_noise deform.pose_noise_probability deform.view_noise "
    "deform.view_noise_symmetric deform.scene_view_dependent deform.scene_direction_dropout "
    "deform.networks_once deform.shading deform.shadow_lights deform.self_shadow "
    "deform.pose_correction_start deform.low_pass deform.unseen_frames isometry_refresh "
    "isometry_samples skinning_points skinning_prefit_steps loss.isometry_centers "
    "loss.isometry_covariances optimisation.rates.means optimisation.rates.pose_correction "
    "optimisation.human_start optimisation.semantics_window"
)
FORMER_SCENE = (
    "scene.cube_opacity scene.backdrop_edge_share scene.backdrop_opacity scene.backdrop_margin "
    "densify_scene densify_scene.max_count"
)
FORMER_SEMANTICS = (
    "semantic_activity loss.semantic loss.binarise event.weight event.start event.floor event.eps "
    "event.across_gaps event.weight_by_activity event.min_active"
)
FORMER = {
    "avatar3dgs": f"{FORMER_NETWORKS} loss.alpha",
    "avatar3dgs_semantic": f"{FORMER_NETWORKS} {FORMER_SCENE} {FORMER_SEMANTICS} semantics "
    "scene.prefit_steps",
    "evsplat": f"{FORMER_NETWORKS} {FORMER_SCENE} {FORMER_SEMANTICS} semantics semantic_start "
    "edi.weight edi.until edi.alone_until exposure.px_per_render exposure.most_renders "
    "windows.start windows.eps windows.contrast_weight windows.reach windows.noise_aware "
    "windows.begun_us windows.pixel_thresholds windows.clock pose.knot_frames",
    "hugs": f"{FORMER_SCENE} mode release_compatible triplane.channels triplane.resolution "
    "fit.steps fit.batch scene.sh_degree loss.human_l1 loss.human_dssim skinning_turns "
    "skinning_refresh optimisation.rates.triplane",
    "paper": f"{FORMER_NETWORKS} {FORMER_SCENE} {FORMER_SEMANTICS}",
}
"""Settings that a config.yaml of the version before had and a method has no more."""


@pytest.mark.parametrize("method", FORMER)
def test_every_setting_of_the_version_before_says_what_became_of_it(method):
    names = f"{FORMER_BODY} {FORMER[method]}".split()
    for name in names:
        with pytest.raises(ConfigError) as error:
            method_config(method, override({}, (f"{name}=1",)), where="config.yaml")
        said = str(error.value)
        parts = [name.rsplit(".", cut)[0] for cut in range(name.count(".") + 1)]
        assert any(said.startswith(f"config.yaml: {part}: ") for part in parts), said
        assert "unknown setting" not in said and "\n" not in said


@pytest.mark.parametrize("method", FORMER)
def test_what_a_setting_was_renamed_to_is_there(method):
    kind = TRAINABLE[method].config
    there = {setting.name for setting in settings(kind())}
    words = [word for word in kind.DROPPED.values() if word.startswith("renamed to ")]
    assert {word.removeprefix("renamed to ") for word in words} <= there


@pytest.mark.parametrize("method", FORMER)
def test_a_configuration_of_the_version_before_is_refused(method):
    old: dict[str, Any] = {"optimisation": {"iterations": 15_000, "rates": {"means": 3e-4}}}
    told = ["optimisation.iterations: renamed to iterations"]
    if method == "hugs":
        old["triplane"] = {"channels": 32, "resolution": 64}
        told.append("triplane: its settings are channels and resolution")
    else:
        old["deform"] = {"width": 128}
        evsplat = method == "evsplat"
        told.append(
            "deform: what evsplat reads of it are width" if evsplat else "deform.width: renamed to "
        )
    if method == "evsplat":
        old["windows"] = {"start": 750, "begun_us": 100_000}
        told += ["windows.begun_us: renamed to event_ramp_us", "windows: its settings are event_st"]
    with pytest.raises(ConfigError) as error:
        method_config(method, old, where="config.yaml")
    said = str(error.value)
    assert [one for one in told if one not in said] == []


@pytest.mark.parametrize("method", ["paper", "avatar3dgs_semantic"])
def test_a_moving_camera_is_refused_with_all_that_has_to_change(tiny_capture, method):
    path = tiny_capture()
    document = json.loads((path / "capture.json").read_text())
    for number, frame in enumerate(document["frames"]):
        pose = np.array(document["cameras"]["main"]["world_to_camera"])
        pose[0, 3] += 0.01 * number
        frame["world_to_camera"] = pose.tolist()
    (path / "capture.json").write_text(json.dumps(document))
    given = [one.partition("=") for one in small(method) if one.startswith("scene.")]
    with pytest.raises(ConfigError, match=r"--set scene.kind=random_cube") as refusal:
        built(method, path)
    names = str(refusal.value).partition("leave out what only backdrops read: ")[2]
    assert given and all(name in names for name, _, _ in given)
    # They are left out where the kind is another.
    assert built(method, path, "scene.kind=random_cube", "scene.cube_count=50")
