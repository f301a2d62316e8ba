"""The report page, put together from its sections."""

from collections.abc import Sequence
from html import escape
from typing import Any

import numpy as np

from evsplat.commands import command
from evsplat.evaluation.report.charts import Series, line_chart
from evsplat.evaluation.report.clip import make_clip
from evsplat.evaluation.report.configuration import configuration, duration, made_with
from evsplat.evaluation.report.figures import (
    distance,
    figures,
    frame_figures,
    no_test_figures,
    references,
)
from evsplat.evaluation.report.frames import frame_by_frame, test_frames
from evsplat.evaluation.report.made import films_and_pages
from evsplat.evaluation.report.source import Source
from evsplat.evaluation.splits import words_of
from evsplat.methods.settings import NOMINAL_ITERATIONS
from evsplat.pages import (
    Embedder,
    data_uri,
    document,
    figure,
    folded,
    legend,
    more,
    section,
)
from evsplat.pictures import to_bytes
from evsplat.pictures.colours import css_gradient
from evsplat.spread import evenly_spread
from evsplat.wording import counted

_PAIRS_OPEN = {"test": 4, "train": 2}
"""Event map pairs shown at once per split; the others are folded."""
_PAIRS_MOST = 24
"""Event map pairs on the page in all, evenly spread."""
_NOVEL_SHOWN = 4
"""Novel views shown per camera, evenly spread over time."""
_HEADLINE = {
    "full": None,
    "person_crop": "on the person’s crop",
    "person_mask": "on the person’s mask",
}
"""Where a figure was reached; of the full frame the split says it."""
_FRAMES_TOGETHER = 10
"""Logged training pictures whose mean PSNR is a point of the curve."""
_REFERENCES = {
    "trivial": ("the best picture that needs no method", "the best without a method"),
    "camera": ("the camera’s own blurry picture", "the camera’s own"),
}
"""References that the headline holds figures against: in full, and after that in short."""


def page(source: Source) -> str:
    """The whole page as HTML; everything that the user's files contributed is escaped."""
    sections = [
        _clip(source),
        figures(source),
        test_frames(source),
        frame_by_frame(source),
        _event_maps(source),
        _novel_views(source),
        _curves(source),
        configuration(source),
        made_with(source),
        films_and_pages(source),
        _next_steps(source),
    ]
    title = f"{source.metrics['capture']} · {source.metrics['method']}"
    body = f"{_header(source)}<main>{''.join(sections)}</main>{_footer(source)}"
    return document(title, body)


def _header(source: Source) -> str:
    metrics = source.metrics
    gaussians = metrics.get("gaussians") or {}
    seconds = metrics.get("train_seconds")
    facts = [
        ("method", metrics["method"]),
        ("trained for", None if seconds is None else duration(seconds)),
        ("iterations", _iterations(source)),
        ("device", metrics.get("device")),
        ("body poses", "found by evsplat" if metrics.get("poses") else None),
        ("Gaussians, person", _count(gaussians.get("human"))),
        ("Gaussians, scene", _count(gaussians.get("scene"))),
        ("frames, train", _count(metrics["frames"]["train"])),
        ("frames, test", _count(metrics["frames"]["test"])),
    ]
    listed = "".join(
        f"<div><dt>{escape(name)}</dt><dd>{escape(str(value))}</dd></div>"
        for name, value in facts
        if value is not None
    )
    return (
        f'<header><p class="kicker">evsplat · report</p><h1>{escape(metrics["capture"])}</h1>'
        f'<p class="lead">{_summary(metrics)}</p><dl class="facts">{listed}</dl></header>'
    )


def _iterations(source: Source) -> str | None:
    """Steps made; where the settings plan for others, also how much of the schedule they were."""
    made, planned = source.metrics.get("iteration"), source.config.get("iterations")
    last = source.log[-1] if source.log else {}
    progress = last.get("nominal") if last.get("iteration") == made else None
    if planned in (None, made) or progress is None:
        return _count(made)
    share = progress / NOMINAL_ITERATIONS
    how_much = "the whole schedule" if share >= 1 else f"{100 * share:.0f} % of the schedule"
    return f"{_count(made)}, {how_much} (planned for {_count(planned)})"


def _summary(metrics: dict[str, Any]) -> str:
    """The headline: PSNR by region, and how far above or below doing nothing it is."""
    method = f"<b>{escape(metrics['method'])}</b>"
    why = no_test_figures(metrics)
    if why is not None:
        return f"{method}: {why}"
    parts: list[str] = []
    for region, where in _HEADLINE.items():
        value = metrics["protocols"]["standard"][region]["psnr"]
        if value is None:
            continue
        against = ", ".join(
            f"{distance(value, theirs, 1)} {_REFERENCES[name][min(len(parts), 1)]}"
            for name, theirs in references(metrics, region).items()
        )
        place = where or words_of(metrics).headline
        parts.append(f"<b>{value:.2f}&nbsp;dB</b> {place}" + (f" ({against})" if against else ""))
    if not parts:
        return f"{method}: no sharp ground truth to compare with, so the pictures must speak."
    return f"{method} reaches {', '.join(parts)}."


def _clip(source: Source) -> str:
    clip = make_clip(source.capture, source.reconstruction)
    if clip is None:
        return ""
    seconds = (clip.last_us - clip.first_us) / 1e6
    return (
        '<section class="hero"><div class="halves"><span>what the camera recorded</span>'
        "<span>reconstruction</span></div>"
        "<video autoplay loop muted playsinline controls "
        'aria-label="what the camera recorded beside the reconstruction" '
        f'src="{data_uri(clip.mp4, "video/mp4")}">'
        "</video>"
        f'<p class="note">{seconds:.2f} s of the recording, {clip.slower:.1f} times slower than '
        f"life: {clip.pictures} pictures drawn, where the camera kept only the average of each "
        "exposure.</p></section>"
    )


def _event_maps(source: Source) -> str:
    events = source.metrics.get("events")
    if events is None:
        reason = source.metrics["reasons"].get("events", "they were not evaluated")
        return section("Event maps", "", f'<p class="note">None: {escape(reason)}.</p>')
    embed = Embedder(lossless=True)
    shown = [
        pair
        for split, count in _PAIRS_OPEN.items()
        for pair in evenly_spread([p for p in events["pairs"] if p["split"] == split], count)
    ]
    rest = [pair for pair in events["pairs"] if pair not in shown]
    others = evenly_spread(rest, _PAIRS_MOST - len(shown))
    scale = (
        "the rendered change of log brightness over the sensor’s contrast threshold"
        if events["threshold_known"]
        else "the rendered change of log brightness, scaled to the strength of the given map "
        "because the sensor’s contrast threshold is unknown"
    )
    means = ", ".join(
        f"{value:.3f} over the {split} pairs"
        for split, value in events["mean_similarity"].items()
        if value is not None
    )
    return section(
        "Event maps",
        f"Given: recorded events between two mid-exposures, summed with their sign. Rendered: "
        f"{scale}. Both of a pair in the same colours. Similarity is the cosine of the two maps"
        f"{': ' if means else ''}{means}.",
        legend(css_gradient(signed=True), "darker", "brighter", "events")
        + _event_pairs(source, shown, embed)
        + folded(more(len(others), len(rest), "pair"), _event_pairs(source, others, embed)),
    )


def _event_pairs(source: Source, pairs: list[dict[str, Any]], embed: Embedder) -> str:
    blocks = []
    for pair in pairs:
        before, after = pair["frames"]
        similarity = "–" if pair["similarity"] is None else f"{pair['similarity']:.2f}"
        images = "".join(
            figure(
                embed.image(source.picture(path), f"{kind} events, frames {before} to {after}"),
                kind,
            )
            for kind, path in pair["pictures"].items()
        )
        blocks.append(
            f'<article class="pair"><h3>{escape(before)} → {escape(after)} <small>'
            f"{escape(pair['split'])} · similarity {similarity} · full colour at "
            f'{pair["full_scale"]:g} events</small></h3><div class="grid n2">{images}</div>'
            "</article>"
        )
    return f'<div class="pairs">{"".join(blocks)}</div>' if blocks else ""


def _novel_views(source: Source) -> str:
    cameras = source.metrics.get("novel_views")
    if not cameras:
        return ""
    camera_pixels = sum(
        source.capture.cameras[c].width * source.capture.cameras[c].height for c in cameras
    )
    embed = Embedder.for_pixels(camera_pixels * _NOVEL_SHOWN * 2)
    views = {view.index: view for view in source.capture.novel_views}
    blocks = []
    for name, values in cameras.items():
        drawn = [entry for entry in values["per_view"] if entry["pictures"]]
        pairs = []
        for entry in evenly_spread(drawn, _NOVEL_SHOWN):
            render = source.picture(entry["pictures"]["render"])
            view = views[entry["index"]]
            truth = to_bytes(source.capture.shown(source.capture.novel_image(view)))
            label = f"{name}, frame {entry['frame']}"
            reached = "" if entry["psnr"] is None else f" · {entry['psnr']:.2f} dB"
            pairs.append(
                '<article class="pair"><div class="grid n2">'
                + figure(embed.image(render, f"render of {label}"), f"render{reached}")
                + figure(embed.image(truth, f"truth of {label}"), f"truth · frame {entry['frame']}")
                + "</div></article>"
            )
        if not pairs:
            continue
        blocks.append(
            f"<h3>{escape(name)} <small>mean of {counted(len(drawn), 'view')}"
            f'{frame_figures(values)}</small></h3><div class="pairs">{"".join(pairs)}</div>'
        )
    if not blocks:
        return ""
    return section(
        "Novel views",
        "Cameras that took no part in the training. One camera does not see what is behind the "
        "person or outside of its own picture, so that large errors there are expected.",
        "".join(blocks),
    )


def _running_mean(line: Series) -> Series:
    """Means of `_FRAMES_TOGETHER` neighbours: frames differ more than training changes them."""
    count = min(_FRAMES_TOGETHER, len(line.x))
    if not count:
        return line
    x, y = (np.convolve(values, np.ones(count) / count, "valid") for values in (line.x, line.y))
    return Series(line.name, x.tolist(), y.tolist())


def _curves(source: Source) -> str:
    log = source.log
    if not log:
        return ""

    def series(name: str, values: Sequence[Any]) -> Series:
        known = [(e["iteration"], v) for e, v in zip(log, values, strict=True) if v is not None]
        return Series(name, [x for x, _ in known], [y for _, y in known])

    terms = dict.fromkeys(term for entry in log for term in (entry.get("terms") or {}))
    losses = [series("loss", [entry.get("loss") for entry in log])] + [
        series(term, [(entry.get("terms") or {}).get(term) for entry in log]) for term in terms
    ]
    counts = [
        series(title, [entry.get(key) for entry in log])
        for key, title in (("human", "person"), ("scene", "scene"))
    ]
    charts = [
        line_chart(losses, x_title="iteration", y_title="Loss and its terms", log=True),
        line_chart(
            [_running_mean(series("psnr", [entry.get("psnr") for entry in log]))],
            x_title="iteration",
            y_title=f"PSNR of the training pictures, dB, means of {_FRAMES_TOGETHER} in turn",
        ),
        line_chart(counts, x_title="iteration", y_title="Gaussians"),
    ]
    return section("Curves", "", f'<div class="charts">{"".join(charts)}</div>')


def _next_steps(source: Source) -> str:
    """Commands that go on from the run, with its folder as it was named."""
    if not source.log:  # a method that does not train has nothing to animate
        return ""
    run = source.folder
    steps = {
        "Look at it from anywhere, at any time": command("view", run),
        "Film another motion": command("render", run, *"--motion spin --path orbit".split()),
        "Share a page in which the person can be posed": command("export", run, "avatar"),
        "Check a recording of your own (docs/own-capture.md)": command("inspect", "FOLDER"),
    }
    listed = "".join(
        f"<li>{escape(what)}: <code>{escape(typed)}</code></li>" for what, typed in steps.items()
    )
    return section("What to do next", "", f"<ul>{listed}</ul>")


def _footer(source: Source) -> str:
    capture = escape(source.metrics["capture"])
    provenance = escape(str(source.capture.provenance.get("text") or "no provenance given."))
    return f"<footer><p>Capture <code>{capture}</code>: {provenance}</p></footer>"


def _count(value: Any) -> str | None:
    """A count with narrow spaces between thousands."""
    return None if value is None else f"{value:,}".replace(",", "\u202f")
