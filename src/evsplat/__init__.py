"""A sharp, animatable 3D Gaussian person in a scene, from a blurry video and events.

The verbs of the command line are functions here, imported on first use:

    import evsplat as ev
    run = ev.train("my_capture", max_minutes=10)
    ev.evaluate(run)
    ev.write_report(run)
    ev.render_run(run, slow=8)

``evsplat render`` is `render_run` here, ``view`` is `view_run`, ``export`` is `export_run`,
``restore`` is `restore_capture`, ``masks`` is `mask_capture` and ``poses`` is `find_poses`: the
first words are names of packages. ``import poses`` is `attach_poses`.
"""

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from evsplat.benching.run import bench
    from evsplat.capture import load_capture
    from evsplat.cli.runs import demo
    from evsplat.evaluation.run import evaluate_run as evaluate
    from evsplat.evaluation.run import write_report
    from evsplat.events.convert import convert_recording as convert
    from evsplat.export import export_run, render_run
    from evsplat.footage.simulate import simulate
    from evsplat.importers import attach_poses, import_capture
    from evsplat.inspection import inspect
    from evsplat.masks import mask_capture
    from evsplat.posing import find_poses
    from evsplat.restore import restore_capture
    from evsplat.staging import stage
    from evsplat.synthesis import synthesize
    from evsplat.training.run import load_run
    from evsplat.training.train import train
    from evsplat.view import view_run

# OpenMP's default is to spin at every barrier. Where another process takes a core, the spinning
# thread starves the one it waits for (two-thread matrix products: five times slower with one busy
# neighbour); sleeping at once costs a quarter of a training step on a quiet machine. A microsecond
# of spinning is the middle. Read once, when torch is imported; what the user has set stays.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("GOMP_SPINCOUNT", "1000")

__version__ = "0.1.0"

__all__ = [
    "Policy",
    "__version__",
    "attach_poses",
    "bench",
    "convert",
    "demo",
    "evaluate",
    "export_run",
    "find_poses",
    "import_capture",
    "inspect",
    "load_capture",
    "load_run",
    "mask_capture",
    "render_run",
    "restore_capture",
    "simulate",
    "stage",
    "synthesize",
    "train",
    "view_run",
    "write_report",
]

_LAZY = {
    "Policy": "evsplat.capture:Policy",
    "attach_poses": "evsplat.importers:attach_poses",
    "bench": "evsplat.benching.run:bench",
    "convert": "evsplat.events.convert:convert_recording",
    "demo": "evsplat.cli.runs:demo",
    "evaluate": "evsplat.evaluation.run:evaluate_run",
    "export_run": "evsplat.export:export_run",
    "find_poses": "evsplat.posing:find_poses",
    "import_capture": "evsplat.importers:import_capture",
    "inspect": "evsplat.inspection:inspect",
    "load_capture": "evsplat.capture:load_capture",
    "load_run": "evsplat.training.run:load_run",
    "mask_capture": "evsplat.masks:mask_capture",
    "render_run": "evsplat.export:render_run",
    "restore_capture": "evsplat.restore:restore_capture",
    "simulate": "evsplat.footage.simulate:simulate",
    "stage": "evsplat.staging:stage",
    "synthesize": "evsplat.synthesis:synthesize",
    "train": "evsplat.training:train",
    "view_run": "evsplat.view:view_run",
    "write_report": "evsplat.evaluation.run:write_report",
}


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module 'evsplat' has no attribute {name!r}")
    module, attribute = _LAZY[name].split(":")
    return getattr(import_module(module), attribute)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
