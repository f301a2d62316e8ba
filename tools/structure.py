"""How large and entangled the package is, and which settings of a method do nothing.

Prints a table, and one JSON object as the last line. ``--inert`` takes minutes: it trains a tiny
capture with each setting changed in turn and compares losses and the final picture bit for bit. A
change that is refused with one sentence is no silent one.
"""

import argparse
import ast
import contextlib
import dataclasses
import hashlib
import io
import json
import logging
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import numpy as np
import torch

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))

from tests import test_imports as imports  # noqa: E402
from tests.conftest import write_tiny_capture  # noqa: E402
from tests.source import SOURCE  # noqa: E402

from evsplat.config import Setting, settings, to_dict  # noqa: E402
from evsplat.config_docs import flow  # noqa: E402
from evsplat.errors import EvsplatError  # noqa: E402
from evsplat.methods import DEFAULT_METHOD, TRAINABLE  # noqa: E402
from evsplat.training import loop  # noqa: E402
from evsplat.training.run import load_run  # noqa: E402
from evsplat.training.train import train  # noqa: E402

CONTAINERS = ("Splats", "Layers")
"""Dataclasses that hold Gaussians between a model and the rasteriser."""
LONGEST_FUNCTION = 80
TRAINING_STEPS = 8


def leaves(method: str) -> list[Setting]:
    """Settings of a method at its defaults, without the sections that they are in."""
    every = settings(TRAINABLE[method].config())
    return [setting for setting in every if not dataclasses.is_dataclass(setting.value)]


def lines(*folders: str) -> int:
    """Lines of Python and C++ in folders."""
    paths = [path for folder in folders for path in (ROOT / folder).rglob("*.*")]
    code = [p.read_text("utf-8") for p in paths if p.suffix in (".py", ".pyi", ".cpp", ".h")]
    return sum(len(text.splitlines()) for text in code)


def circles(*, of_folders: bool) -> list[list[str]]:
    """Files, or folders as ARCHITECTURE.md lists them, that import each other."""
    folders: dict[str, set[str]] = {folder: set() for folder in imports.RANK}
    for module, target, _ in imports.imports():
        here, there = (imports.place(name, imports.RANK) for name in (module, target))
        folders[here] |= {there} - {here, "evsplat"}
    return list(map(sorted, imports.circles(folders if of_folders else imports.files_run())))


def homes(method: str) -> list[str]:
    """Modules in which defaults of a method stand: its own, and those of values that have some."""
    kinds = {setting.owner for setting in settings(TRAINABLE[method].config())}
    missing = dataclasses.MISSING
    return sorted(
        {
            kind.__module__
            for kind in kinds
            for field in dataclasses.fields(kind)
            if field.default is not missing or field.default_factory is not missing
        }
    )


def tiny_capture(folder: Path, *, jitter_rad: float) -> Path:
    """The capture of the tests, its poses jittered and its thresholds not those of a guess."""
    path = write_tiny_capture(folder / f"tiny-{jitter_rad}")
    metadata = json.loads((path / "capture.json").read_text("utf-8"))
    metadata["events"]["contrast_threshold"] = [0.31, 0.27]
    (path / "capture.json").write_text(json.dumps(metadata), "utf-8")
    body = dict(np.load(path / "body.npz"))
    noise = np.random.default_rng(0).normal(0, jitter_rad, body["poses"].shape)
    np.savez(path / "body.npz", **body | {"poses": np.float32(body["poses"] + noise)})
    return path


def trained(capture: Path, method: str, *changes: str) -> Path:
    """Run folder of a short training."""
    out = Path(tempfile.mkdtemp(dir=capture.parent))
    overrides = (f"iterations={TRAINING_STEPS}", *changes)
    with contextlib.redirect_stderr(io.StringIO()):
        return train(capture, method=method, out=out, device="cpu", overrides=overrides)


def fingerprint(run: Path) -> str:
    """Losses of all steps, and a digest of the final picture."""
    found = load_run(run, device="cpu")
    frame = found.capture.frames[-1]
    drawn = found.reconstruction.render(found.capture.camera(frame), [frame.mid_us])
    digest = hashlib.sha256(drawn.rgb.numpy().tobytes() + drawn.human.numpy().tobytes())
    steps = map(json.loads, (run / "log.jsonl").read_text().splitlines())
    return repr([(step["loss"], step["psnr"]) for step in steps]) + digest.hexdigest()


def other_values(setting: Setting) -> Iterator[Any]:
    """Values to try instead of a default; not all of them need be in range."""
    value = to_dict(setting.value)
    hints = (setting.hint, *get_args(setting.hint))
    if isinstance(value, bool):
        yield not value
    elif choices := [hint for hint in hints if get_origin(hint) is Literal]:
        yield from get_args(choices[0])
    elif isinstance(value, int | float):
        for other in (value * 1.7 + 0.05, value * 0.4, value * 2 + 1, value * 0.01, 0, 1, 2):
            yield round(other) if isinstance(value, int) else float(other)
    elif value is None:
        yield from (0.5, 3, {}, 1, 1_000, [3_000.0])
    elif value and isinstance(value[0], list):
        yield [[start, 2 * later + 0.01] for start, later in value]
    elif isinstance(value, list):
        yield [0.5 * part for part in value] or [3_000.0]


def verdict(setting: Setting, capture: Path, method: str, before: str) -> str:
    """``live``, else ``inert``, else ``refused``, or what went wrong with all that was tried."""
    found = ["untried"]
    for value in (v for v in other_values(setting) if v != to_dict(setting.value)):
        try:
            after = fingerprint(trained(capture, method, f"{setting.name}={flow(value)}"))
            found.append("inert" if after == before else "live")
        except EvsplatError as error:
            found += [] if "; expected " in str(error) else ["refused"]
        except Exception as error:
            found.append(type(error).__name__)
        if found[-1] == "live":
            break
    return next((word for word in ("live", "inert", "refused") if word in found), found[-1])


def effects(folder: Path, method: str) -> dict[str, list[str]]:
    """Settings by verdict; what is inert with exact poses is tried with noisy ones."""
    said = {s.name: "live" if s.name == "iterations" else "inert" for s in leaves(method)}
    for jitter_rad in (0.0, 0.05):
        capture = tiny_capture(folder, jitter_rad=jitter_rad)
        before = fingerprint(trained(capture, method))
        assert fingerprint(trained(capture, method)) == before
        for setting in leaves(method):
            if said[setting.name] == "inert":
                said[setting.name] = verdict(setting, capture, method, before)
                print(f"{setting.name}: {said[setting.name]}", file=sys.stderr, flush=True)
    return {word: [n for n in said if said[n] == word] for word in set(said.values())}


def measured(method: str, *, inert: bool) -> dict[str, Any]:
    """The table."""
    folder = "models"
    files = {p: len(p.read_text("utf-8").splitlines()) for p in SOURCE.rglob("*.py")}
    nodes = [(module, n) for module, tree in imports.files().items() for n in ast.walk(tree)]
    classes = {node.name for _, node in nodes if isinstance(node, ast.ClassDef)}
    defined = [(f"{module}.{n.name}", n) for module, n in nodes if hasattr(n, "returns")]
    functions = [(node.end_lineno - node.lineno + 1, name) for name, node in defined]
    rows: dict[str, Any] = {
        "settings": {each: len(leaves(each)) for each in TRAINABLE},
        "distinct settings": len({s.name for each in TRAINABLE for s in leaves(each)}),
        f"files with defaults of {method}": homes(method),
        f"largest file of {folder}": max(
            (n, p.name) for p, n in files.items() if SOURCE / folder in p.parents
        ),
        "longest function": max(functions),
        f"functions above {LONGEST_FUNCTION} lines": sorted(
            f for f in functions if f[0] > LONGEST_FUNCTION
        ),
        "Gaussian containers": [name for name in CONTAINERS if name in classes],
        "folder circles": circles(of_folders=True),
        "file circles": circles(of_folders=False),
        "lines of src and native": lines("src", "native"),
        "lines of tests": lines("tests"),
        "modules in src": len(files),
    }
    with tempfile.TemporaryDirectory() as name:
        run = trained(tiny_capture(Path(name), jitter_rad=0.01), method)
        sets = load_run(run, device="cpu").reconstruction.model.sets
        human = next(each for each in sets.values() if each.human_count)
        one = [getattr(human, name)[0] for name in human.attributes]
        rows["floats per person Gaussian"] = sum(values.numel() for values in one)
        if inert:
            rows[f"settings of {method} by effect"] = effects(Path(name), method)
    return rows


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--inert", action="store_true", help="find settings that do nothing")
    parser.add_argument("--method", default=DEFAULT_METHOD, choices=TRAINABLE)
    options = parser.parse_args()
    logging.disable()
    torch.set_num_threads(1)
    loop.LOG_EVERY = 1
    for title, value in (rows := measured(options.method, inert=options.inert)).items():
        print(f"| {title} | {f'{len(value)}: ' if isinstance(value, list) else ''}{value} |")
    print(json.dumps(rows))


if __name__ == "__main__":
    main()
