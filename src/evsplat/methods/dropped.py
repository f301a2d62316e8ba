"""Settings of earlier versions, and what became of them: for run folders and habits of users."""

_RENAMED = {
    "optimisation.iterations": "renamed to iterations",
    "optimisation.rates": "its values are in the section rates",
    "optimisation": "its parts are iterations and the section rates; the rest is fixed",
    "densify_human.max_count": "renamed to densify.max_human",
    "densify_human": "renamed to densify",
    "densify_scene": "the scene's limit is scene.cube_max_count, the others are 3DGS's",
    "human.max_count": "fixed at 20,000",
    "human.opacity": "fixed by the method",
    "human.width": "fixed by the method",
    "human.flatness": "fixed by the method",
    "scene.cube_opacity": "fixed at 0.1",
    "scene.backdrop_edge_share": "fixed at 0.18",
    "scene.backdrop_opacity": "fixed at 0.9",
    "scene.backdrop_margin": "fixed at 0.15",
    "loss.l1": "renamed to l1_weight",
    "loss.dssim": "renamed to dssim_weight",
    "isometry_refresh": "fixed at 100",
    "skinning_points": "fixed at 1,024",
}

_EVENTS = {
    "event.weight": "renamed to event_weight",
    "event.start": "renamed to event_start",
    "event.across_gaps": "gone, no run showed a gain (docs/experiments/gone.md)",
    "semantic_activity": "gone, no run showed a gain (docs/experiments/gone.md)",
}

_NETWORKS = {
    "deform.encoding": "gone, the encoding is one-blob (docs/experiments/gone.md)",
    "deform.precision": "gone, networks compute in float32 (docs/experiments/gone.md)",
    "deform.skinning_grid": "gone, evsplat has no skinning network (docs/experiments/gone.md)",
    "deform.pose_correction_start": "renamed to networks.pose_start",
    "deform.width": "renamed to networks.width",
    "deform.colour_width": "renamed to networks.colour_width",
    "deform.non_rigid_start": "renamed to networks.non_rigid_start",
    "deform.pose_noise": "renamed to networks.pose_noise",
    "deform": "its settings are in the section networks, or fixed by the method",
    "isometry_samples": "renamed to terms.isometry_samples",
    "skinning_prefit_steps": "renamed to terms.skinning_prefit_steps",
    "loss": "its weights are l1_weight, dssim_weight and the section terms",
}

_SCENE = {
    "deform.scene_direction_dropout": "renamed to scene_direction_dropout",
    "loss.semantic": "renamed to semantic_weight",
    "loss.binarise": "renamed to binarise_weight",
}

AVATAR = {**_RENAMED, **_NETWORKS, "loss.alpha": "renamed to alpha_weight"}
"""Of `avatar3dgs`."""

AVATAR_SEMANTIC = {
    **_RENAMED,
    **_NETWORKS,
    **_SCENE,
    "semantics": "fixed: the rendered attribute teaches it",
    "semantic_activity": _EVENTS["semantic_activity"],
    "event": "avatar3dgs_semantic has no event term",
    "scene.prefit_steps": "avatar3dgs_semantic fits nothing to the median before training",
}
"""Of `avatar3dgs_semantic`."""

PAPER = {
    **_RENAMED,
    **_EVENTS,
    **_NETWORKS,
    **_SCENE,
    "event": "its settings begin with event_, as event_weight",
}
"""Of `paper`."""

_NON_RIGID = (
    "gone, it bent nothing (docs/experiments/outline-and-light.md); shade_start is that of the "
    "brightness by pose"
)

EVSPLAT = {
    **_RENAMED,
    **_EVENTS,
    "deform.shadow_lights": "renamed to lamps",
    "deform.pose_correction_start": "evsplat reads pose.refine and pose.start instead",
    "deform.non_rigid_start": _NON_RIGID,
    "non_rigid_start": _NON_RIGID,
    "rates.non_rigid": "renamed to rates.shade",
    "deform": "what evsplat reads of it are width, shading, lamps, self_shadow, low_pass "
    "and pose_noise",
    "loss.semantic": "renamed to semantic_weight",
    "loss.binarise": "renamed to binarise_weight",
    "loss": "its weights are l1_weight, dssim_weight, semantic_weight and binarise_weight",
    "isometry_samples": "evsplat has no isometry term",
    "skinning_prefit_steps": "evsplat has no skinning network",
    "semantics": "evsplat learns the attribute by the posed silhouette only "
    "(docs/experiments/gone.md)",
    "semantic_start": "fixed at 2",
    "edi": "gone, sharpened frames as targets lost 0.15 dB (docs/experiments/gone.md)",
    "event": "its settings begin with event_, as event_weight",
    "exposure": "its settings are px_per_render and most_renders",
    "pose.noisy_rad": "gone, the shape of a curve does not tell exact poses from wrong ones; "
    "body.source of capture.json does (docs/capture-format.md)",
    "windows.pixel_thresholds": "gone, no run showed a gain (docs/experiments/gone.md)",
    "windows.begun_us": "renamed to event_ramp_us",
    "windows": "its settings are event_start, event_eps, event_reach, event_ramp_us, "
    "event_noise_aware, contrast_weight and clock",
    "pose.knot_frames": "fixed at 1",
}
"""Of `evsplat`."""

HUGS = {
    **_RENAMED,
    "mode": "gone with the mode human; method avatar3dgs reconstructs a person alone",
    "release_compatible": "gone, it repeated slips of the released code (docs/baselines.md)",
    "triplane": "its settings are channels and resolution",
    "fit.steps": "renamed to fit_steps",
    "fit": "its setting is fit_steps",
    "scene.sh_degree": "renamed to sh_degree",
    "loss": "its weights are l1_weight, dssim_weight, human_l1_weight, human_dssim_weight, "
    "skinning_weight, perceptual and perceptual_weight",
    "skinning_turns": "fixed at 4",
    "skinning_refresh": "fixed at 50",
    "optimisation.rates": "rates are the released ones, times rate_scale",
    "optimisation": "its parts are iterations and rate_scale; the rest is fixed",
}
"""Of `hugs`."""
