"""capture.json: from JSON to `Metadata`, every fault noted."""

from pathlib import Path
from typing import Any

from evsplat.body.pose_errors import POSE_SOURCES
from evsplat.capture.fields import Fields
from evsplat.capture.finding import Findings, reason_and_remedy
from evsplat.capture.metadata import EventsEntry, Metadata
from evsplat.capture.parse_cameras import parse_cameras
from evsplat.capture.parse_frames import at_rest, parse_frames, parse_novel_views
from evsplat.errors import DataError
from evsplat.options.inputs import no_capture
from evsplat.untrusted.faults import brief
from evsplat.untrusted.text import read_json

FORMAT = "evsplat-capture"
VERSION = 1
BODY_MODELS = ("rig", "default", "smpl", "smplh", "smplx")
# Sensors have thresholds of 0.1 to 0.6; simulations may go further.
_THRESHOLDS = (1e-3, 10.0)


def read_metadata(path: Path, findings: Findings) -> Metadata | None:
    """Read ``path``/capture.json; faults go to ``findings``.

    None where the file as a whole cannot be used; entries with errors are left out otherwise.
    """
    file = path / "capture.json"
    if missing := no_capture(path):
        where, found, expected, remedy = missing
        findings.error(where, "", found, expected, remedy)
        return None
    try:
        document = read_json(file)
    except DataError as error:
        reason, remedy = reason_and_remedy(error, file)
        remedy = remedy or "Is this a capture folder?"
        expected = "the capture's description as a JSON object"
        findings.error(file, "", reason, expected, remedy)
        return None
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        found = repr(document.get("format")) if isinstance(document, dict) else "no JSON object"
        findings.error(file, "format", found, repr(FORMAT), "Import the recording as a capture.")
        return None
    if document.get("version") != VERSION or isinstance(document.get("version"), bool):
        findings.error(
            file,
            "version",
            repr(document.get("version")),
            str(VERSION),
            "This evsplat reads version 1: update evsplat or convert the capture.",
        )
        return None
    return _parse(file, document, findings)


def _parse(file: Path, document: dict[str, Any], findings: Findings) -> Metadata:
    known = ("format", "version", "name", "cameras", "frames", "novel_views", "body", "events")
    top = Fields(file, "", document, (*known, "up", "provenance"), findings)
    cameras, distortions, transfers = parse_cameras(top)
    frames = parse_frames(top, cameras)
    novel_views = parse_novel_views(top, cameras, frames)
    cameras, frames = at_rest(cameras, frames, novel_views)
    body = _body(top)
    provenance = document.get("provenance", {})
    body_file = body.path("file") if body else None
    return Metadata(
        path=top.folder,
        name=top.name("name"),
        cameras=cameras,
        distortions=distortions,
        transfers=transfers,
        frames=frames,
        novel_views=novel_views,
        body_file=body_file or top.folder / "body.npz",
        body_model=_body_model(body) if body else "",
        body_source=body.choice("source", POSE_SOURCES) if body else None,
        events=_events(top),
        up=_up(top),
        provenance=provenance if isinstance(provenance, dict) else {"text": str(provenance)},
    )


def _up(top: Fields) -> tuple[float, float, float] | None:
    value = top.numbers("up", (3,), None)
    if value is None:
        return None
    if not value.any():
        top.fail(
            "up",
            str(value.tolist()),
            "the direction of the world that is upwards, such as [0, 0, 1]",
            "Correct it, or leave it out to have it found.",
        )
        return None
    x, y, z = value.tolist()
    return x, y, z


def _body(top: Fields) -> Fields | None:
    if "body" in top.value and top.value["body"] is None:
        top.findings.warning(
            top.file,
            "body",
            "null: no body",
            "a body and its poses",
            "Training needs them: 'evsplat poses' finds them.",
        )
        return None
    keys = ("file", "model", "source")
    return top.inner("body", top.get("body"), keys) if top.has("body") else None


def _body_model(body: Fields) -> str:
    model = body.text("model")
    if body.valid and model not in BODY_MODELS:
        body.fail("model", repr(model), f"one of {list(BODY_MODELS)}", "Correct it.")
    return model


def _events(top: Fields) -> EventsEntry | None:
    value = top.value.get("events")
    if value is None:
        return None
    keys = ("file", "width", "height", "contrast_threshold", "simulated", "clock_offset_us")
    entry = top.inner("events", value, keys)
    file = entry.path("file")
    width, height = entry.integer("width", minimum=1), entry.integer("height", minimum=1)
    thresholds = entry.numbers("contrast_threshold", (2,), None)
    low, high = _THRESHOLDS
    if thresholds is not None and not ((thresholds >= low) & (thresholds <= high)).all():
        entry.fail(
            "contrast_threshold",
            str(thresholds.tolist()),
            f"two positive numbers [C+, C-], {low:g} to {high:g}, or null",
            "Give magnitudes of a change of the natural logarithm, or null where unknown.",
        )
    simulated = entry.get("simulated", False)
    if not isinstance(simulated, bool):
        entry.fail("simulated", brief(simulated), "true or false", "Correct it.")
    offset = entry.integer("clock_offset_us", 0)
    if not entry.valid or file is None:
        return None
    pair = None if thresholds is None else (float(thresholds[0]), float(thresholds[1]))
    return EventsEntry(file, width, height, pair, simulated, offset)
