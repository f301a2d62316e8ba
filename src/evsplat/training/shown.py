"""A checkpoint's model as those who look at it draw it: with what the end of training decided."""

from torch import Tensor

from evsplat.gaussians import Rows
from evsplat.models.model import Model
from evsplat.models.seen import Seen
from evsplat.models.solid_scene import SolidScene
from evsplat.render.reference import MIN_ALPHA
from evsplat.training.checkpoint import below, load_model


def load_shown(
    model: Model, tensors: dict[str, Tensor], human_count: int
) -> tuple[Seen | None, SolidScene | None]:
    """Give a model the parameters that a checkpoint is drawn with, and tell what training saw.

    Gaussians of the person whose opacity the end of training made less than any pixel shows are
    left out, of what was seen as well: pictures stay the same, and files hold what can be seen. The
    checkpoint keeps them, with what was learned, for a training that goes on.

    Returns what was seen, None where the checkpoint does not tell, being from before the end, and
    the scene as it is seen from elsewhere, None where there is none.

    Raises:
        ValueError: Numbers are not finite, or attributes are not of as many Gaussians.
    """
    load_model(model, tensors, human_count, filled=True)
    seen = Seen.of(below("seen", tensors), human_count)
    scene_count = sum(len(rows) - rows.human_count for rows in model.sets.values())
    solid = SolidScene.of(below("solid", tensors), scene_count, model.device)
    decided = below("filled", tensors)
    for name, rows in model.sets.items():
        if not rows.holds("human") or f"{name}.opacity_logits" not in decided:
            continue
        kept = rows.shape().opacities >= MIN_ALPHA
        kept[rows.scene] = True
        if bool(kept.all()):
            continue
        if seen is not None:
            of_person = kept[rows.human].cpu()
            seen = Seen(*(value[of_person.to(value.device)] for value in vars(seen).values()))
        _keep(rows, kept)
        for cache in model.row_caches.values():
            cache.rows_changed()
    return seen, solid


def _keep(rows: Rows, kept: Tensor) -> None:
    values = {name: rows.get_parameter(name)[kept] for name in rows.attributes}
    rows.set_rows(values, int(kept[rows.human].sum()))
