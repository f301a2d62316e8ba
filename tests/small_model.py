"""Settings under which a training step takes milliseconds."""

SMALL_MODEL = (
    "human.count=120",
    "scene.prefit_steps=3",
    "skinning_prefit_steps=3",
    "deform.width=16",
    "deform.colour_width=16",
    "isometry_samples=64",
    "densify_human.max_count=150",
)
