"""``evsplat doctor``: what is installed, what is missing and where to get it."""

import json as json_format
import os
import platform
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import partial
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from typing import Literal

import evsplat
from evsplat.cuda_support import Need, needs
from evsplat.errors import DataError, WeightsError
from evsplat.options.declare import Flag
from evsplat.shipped import demo_capture
from evsplat.wording import counted

_RESTORERS_WITH_WEIGHTS = ("nafnet", "mprnet", "efnet", "d2net", "e2vid")
_TITLES = {"missing": "missing", "ok": "there", "optional": "optional, not there"}


@dataclass(frozen=True)
class Check:
    """Finding about one thing that evsplat can use."""

    name: str
    status: Literal["ok", "missing", "optional"]
    """missing: evsplat does not work without it; optional: it does, with less."""
    detail: str
    remedy: str = ""
    """Way to get it, where it is not there."""


def doctor(*, json: Flag = False) -> None:
    """Say what is installed, what is missing and where to get it.

    Args:
        json: Print one JSON object instead of lines.
    """
    checks = list(run_checks())
    if json:
        found = {check.name: asdict(check) for check in checks}
        print(json_format.dumps(found, indent=1))
        return
    width = max(len(check.name) for check in checks)
    for status, title in _TITLES.items():
        among = [check for check in checks if check.status == status]
        if among:
            print(f"{title}:")
        for check in among:
            print(f"  {check.name:{width}}  {check.detail} {check.remedy}".rstrip())
    missing = ", ".join(check.name for check in checks if check.status == "missing")
    print(f"ready: no, for want of {missing}" if missing else "ready: yes")


def run_checks() -> Iterator[Check]:
    """Look at the installation, one check after the other; none of them raises."""
    machine = f"{platform.system()} {platform.machine()}, {os.cpu_count()} CPU cores"
    yield Check("evsplat", "ok", evsplat.__version__)
    yield Check("python", "ok", f"{platform.python_version()} on {machine}")
    checks: tuple[Callable[[], Check], ...] = (
        _torch,
        _native,
        *(partial(_for_cuda, need) for need in needs()),
        _video,
        _demo,
        _viewer,
        _body_models,
        _opencv,
        _super_slomo,
        *(partial(_restorer, name) for name in _RESTORERS_WITH_WEIGHTS),
        _pienet,
        _recordings,
        _st_lpips,
        lambda: _lpips("alex"),
        lambda: _lpips("vgg"),
        _rvm,
    )
    for check in checks:
        yield check()


def _torch() -> Check:
    try:
        torch = import_module("torch")
    except ImportError as error:
        return Check("torch", "missing", f"{error}.", "Get it with: pip install 'torch>=2.11'.")
    threads = counted(torch.get_num_threads(), "thread")
    return Check("torch", "ok", f"{torch.__version__}, {threads}")


def _native() -> Check:
    name = "native rasteriser"
    try:
        native = import_module("evsplat._native")
    except ImportError as error:
        remedy = "Reinstall evsplat with a C++17 compiler (GCC 9+, Clang 12+) present."
        return Check(name, "missing", f"{error}.", remedy)
    levels = ", ".join(native.levels())
    return Check(name, "ok", f"uses {native.level()} (this CPU runs {levels})")


def _for_cuda(need: Need) -> Check:
    return Check(need.name, "ok" if need.there else "optional", need.detail, need.remedy)


def _video() -> Check:
    try:
        av = import_module("av")
    except ImportError as error:
        return Check("video (PyAV)", "missing", f"{error}.", "Get it with: pip install av.")
    if "libx264" not in av.codecs_available:
        remedy = "Get it with: pip install --force-reinstall --only-binary av av."
        return Check("video (PyAV)", "optional", f"{av.__version__}, no H.264 encoder.", remedy)
    return Check("video (PyAV)", "ok", f"{av.__version__} with H.264")


def _demo() -> Check:
    try:
        return Check("demo capture", "ok", str(demo_capture()))
    except DataError as error:
        return Check("demo capture", "missing", str(error))


def _viewer() -> Check:
    parts = ("viser", "msgspec", "websockets")
    found = Check("viewer", "ok", f"viser {_version('viser')}")
    return _without(parts, "view", "evsplat view, html clips", found)


def _body_models() -> Check:
    name = "SMPL bodies"
    found = _version("body-models")
    if found is None:
        remedy = "Get it with: pip install 'evsplat[body-models]' (and your own SMPL files)."
        return Check(name, "optional", "package body-models is not installed.", remedy)
    folder = os.environ.get("EVSPLAT_BODY_MODELS")
    if not folder:
        files = "set EVSPLAT_BODY_MODELS to your SMPL files"
    elif os.path.exists(folder):
        files = f"files in {folder}"
    else:
        detail = f"body-models {found}, but EVSPLAT_BODY_MODELS is {folder}, which is not there."
        return Check(name, "optional", detail, "Set it to your SMPL files.")
    return Check(name, "ok", f"body-models {found}, {files}")


def _opencv() -> Check:
    name = "optical flow"
    try:
        cv2 = import_module("cv2")
    except ImportError:
        remedy = "Get it with: pip install 'evsplat[synthesize]'."
        return Check(name, "optional", "OpenCV is not installed.", remedy)
    return Check(name, "ok", f"OpenCV {cv2.__version__}")


def _super_slomo() -> Check:
    from evsplat.synthesis.super_slomo import CHECKPOINT

    return _weights("Super SloMo", lambda: f"weights {CHECKPOINT.find()}")


def _restorer(name: str) -> Check:
    from evsplat.restore import WEIGHT_FILES

    file = WEIGHT_FILES[name]
    return _weights(file.network, lambda: f"weights {file.find()}")


def _pienet() -> Check:
    from evsplat.restore.pienet import DISTRIBUTION, find_weights

    package = f"{DISTRIBUTION} {_version(DISTRIBUTION)}"
    return _weights("PIE-Net", lambda: f"{find_weights().name} of {package}")


def _recordings() -> Check:
    parts = ("hdf5plugin", "rosbags", "zstandard")
    found = Check("event recordings", "ok", "every format: docs/event-formats.md")
    return _without(parts, "recordings", "ROS bags, packed HDF5, Zstandard", found)


def _without(parts: tuple[str, ...], extra: str, lacking: str, found: Check) -> Check:
    """``found``, or what is lacking where one of the extra's packages is not installed."""
    absent = [part for part in parts if find_spec(part) is None]
    if not absent:
        return found
    detail = f"{lacking}: {', '.join(absent)} not installed."
    return Check(found.name, "optional", detail, f"Get it with: pip install 'evsplat[{extra}]'.")


def _st_lpips() -> Check:
    if find_spec("stlpips_pytorch") is None:
        remedy = "Get it with: pip install 'evsplat[perceptual]' (64 MB)."
        return Check("ST-LPIPS", "optional", "weights are not installed.", remedy)
    return Check("ST-LPIPS", "ok", f"weights of stlpips-pytorch {_version('stlpips-pytorch')}")


def _lpips(network: Literal["alex", "vgg"]) -> Check:
    from evsplat.similarity.lpips import load_lpips

    name = f"LPIPS {network}"
    try:
        load_lpips(network)
    except WeightsError as error:
        return Check(name, "optional", str(error))
    return Check(name, "ok", "weights found")


def _rvm() -> Check:
    from evsplat.masks.rvm import find_weights

    return _weights("RVM masks", lambda: str(find_weights()))


def _weights(name: str, found: Callable[[], str]) -> Check:
    """What is ``found`` of a network, or the `WeightsError` that says how to get it."""
    try:
        return Check(name, "ok", found())
    except WeightsError as error:
        return Check(name, "optional", str(error))


def _version(distribution: str) -> str | None:
    try:
        return version(distribution)
    except PackageNotFoundError:
        return None
