"""The report page, put together from its sections."""

from collections.abc import Sequence
from html import escape
from importlib import resources
from typing import Any, TypeVar

import numpy as np
from jaxtyping import UInt8

from evsplat.evaluation.pictures import (
    ERROR_FULL_SCALE,
    css_gradient,
    error_map,
    to_bytes,
)
from evsplat.evaluation.regions import Box
from evsplat.evaluation.report.charts import Series, line_chart
from evsplat.evaluation.report.clip import make_clip
from evsplat.evaluation.report.embed import Embedder, data_uri
from evsplat.evaluation.report.source import Source
from evsplat.evaluation.tables import (
    METRIC_TITLES,
    REGION_TITLES,
    Table,
    missing_networks,
    tables_of,
)

_FRAMES_OPEN = 6
"""Test frames shown at once; the others are folded."""
_T = TypeVar("_T")

_NOVEL_SHOWN = 4
"""Novel views shown per camera, evenly spread over time."""


def page(source: Source) -> str:
    """The whole page as HTML; everything that the user's files contributed is escaped."""
    sections = [
        _clip(source),
        _figures(source),
        _test_frames(source),
        _event_maps(source),
        _novel_views(source),
        _curves(source),
        _configuration(source),
    ]
    title = f"{source.metrics['capture']} · {source.metrics['method']}"
    style = (resources.files("evsplat") / "data" / "report.css").read_text(encoding="utf-8")
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        '<meta name="color-scheme" content="light dark">'
        f"<title>{escape(title)}</title><style>{style}</style></head><body>"
        f"{_header(source)}<main>{''.join(sections)}</main>{_footer(source)}</body></html>\n"
    )


def _header(source: Source) -> str:
    metrics = source.metrics
    gaussians = metrics.get("gaussians") or {}
    facts = [
        ("method", metrics["method"]),
        ("trained for", _duration(metrics.get("train_seconds"))),
        ("iterations", _count(metrics.get("iteration"))),
        ("device", metrics.get("device")),
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


def _summary(metrics: dict[str, Any]) -> str:
    """One sentence: how good, and how much better than doing nothing."""
    ours = metrics["protocols"]["standard"]
    full, crop = ours["full"]["psnr"], ours["person_crop"]["psnr"]
    method = f"<b>{escape(metrics['method'])}</b>"
    if full is None:
        return f"{method}: no sharp ground truth to compare with, so the pictures must speak."
    sentence = f"{method} reaches <b>{full:.2f} dB</b> on held-out frames"
    if crop is not None:
        sentence += f", <b>{crop:.2f} dB</b> on the person"
    trivial = [row["full"]["psnr"] for row in metrics["trivial"].values()]
    known = [value for value in trivial if value is not None]
    if known:
        gain = full - max(known)
        word = "above" if gain >= 0 else "below"
        sentence += f": {abs(gain):.1f} dB {word} the best picture that needs no method"
    return sentence + "."


def _clip(source: Source) -> str:
    clip = make_clip(source.capture, source.reconstruction)
    if clip is None:
        return ""
    seconds = (clip.last_us - clip.first_us) / 1e6
    return (
        '<section class="hero"><div class="halves"><span>what the camera recorded</span>'
        "<span>reconstruction</span></div>"
        f'<video autoplay loop muted playsinline controls src="{data_uri(clip.mp4, "video/mp4")}">'
        "</video>"
        f'<p class="note">{seconds:.2f} s of the recording, {clip.slower:.1f} times slower than '
        f"life: {clip.pictures} sharp pictures drawn for instants of which the camera only kept "
        "the average.</p></section>"
    )


def _figures(source: Source) -> str:
    first, *others = tables_of(source.metrics)
    folded = "".join(
        f"<details><summary>Protocol <code>{escape(table.protocol)}</code></summary>"
        f"{_table(table)}</details>"
        for table in others
    )
    missing = "".join(f"<li>{escape(reason)}</li>" for reason in missing_networks(source.metrics))
    against = source.metrics["blurry_ground_truth"]["full"]["psnr"]
    blurry = (
        f"<li>Against the blurry pictures instead of the sharp truth (no measure of deblurring): "
        f"{against:.2f} dB full frame.</li>"
        if against is not None
        else ""
    )
    return _section(
        "Figures",
        f"Means over {source.metrics['frames']['test']} held-out frames against the sharp picture "
        "at mid-exposure.",
        f'{_cards(first)}{_table(first)}{folded}<ul class="note">{blurry}{missing}</ul>',
    )


def _cards(table: Table) -> str:
    """Large PSNR figures with the distance to the better trivial row."""
    cards = []
    for column in table.columns:
        value = table.value(table.method, column)
        if column.metric != "psnr" or value is None:
            continue
        trivial = [
            other
            for row in table.rows
            if row not in (table.method, "blurry_input")
            and (other := table.value(row, column)) is not None
        ]
        gain = ""
        if trivial:
            difference = value - max(trivial)
            kind = "up" if difference >= 0 else "down"
            gain = f'<p class="{kind}">{difference:+.2f} dB over the best trivial row</p>'
        cards.append(
            f'<div class="card"><p>{REGION_TITLES[column.region]}</p>'
            f'<p class="big">{value:.2f}<small> dB</small></p>{gain}</div>'
        )
    return f'<div class="cards">{"".join(cards)}</div>'


def _table(table: Table) -> str:
    groups = "".join(
        f'<th colspan="{span}" scope="colgroup">{title}</th>'
        for region, title in REGION_TITLES.items()
        if (span := sum(column.region == region for column in table.columns))
    )
    names = "".join(
        f'<th scope="col">{METRIC_TITLES[c.metric]}&thinsp;{"↑" if c.higher_is_better else "↓"}</th>'
        for c in table.columns
    )
    rows = []
    for row in table.rows:
        cells = "".join(
            f"<td{' class=best' if table.is_best(row, c) else ''}>{table.text(row, c)}</td>"
            for c in table.columns
        )
        kind = "ours" if row == table.method else "other"
        if row == "blurry_input":
            kind = "aside"
        rows.append(f'<tr class="{kind}"><th scope="row">{escape(table.title(row))}</th>{cells}</tr>')
    return (
        f'<div class="scroll"><table><thead><tr><th rowspan="2" class="corner">protocol '
        f"<code>{escape(table.protocol)}</code></th>{groups}</tr><tr>{names}</tr></thead>"
        f'<tbody>{"".join(rows)}</tbody></table></div><p class="note">{escape(table.note)}.</p>'
    )


def _test_frames(source: Source) -> str:
    frames = source.metrics["per_frame"]
    if not frames:
        return _section("Test frames", "", '<p class="note">No frame has split “test”.</p>')
    first = source.capture.camera(source.capture.frame(frames[0]["frame"]))
    # Four full pictures and four crops of about a third of the area per frame.
    embed = Embedder.for_pixels(int(len(frames) * first.width * first.height * 5.3))
    cards = [_test_frame(source, entry, embed) for entry in frames]
    more = ""
    if len(cards) > _FRAMES_OPEN:
        more = (
            f"<details><summary>{len(cards) - _FRAMES_OPEN} more test frames</summary>"
            f"{''.join(cards[_FRAMES_OPEN:])}</details>"
        )
    legend = _legend(
        css_gradient(signed=False), "0", f"{ERROR_FULL_SCALE} levels of 255 and more", "error"
    )
    intro = "Held out of the training. Below each frame: the person, enlarged."
    return _section("Test frames", intro, legend + "".join(cards[:_FRAMES_OPEN]) + more)


def _test_frame(source: Source, entry: dict[str, Any], embed: Embedder) -> str:
    frame = source.capture.frame(entry["frame"])
    pictures: dict[str, UInt8[np.ndarray, "H W 3"]] = {
        "blurry input": to_bytes(source.capture.image(frame)),
        "our render": source.picture(entry["pictures"]["render"]),
    }
    if frame.sharp is not None:
        pictures["sharp truth"] = to_bytes(source.capture.sharp(frame))
        pictures["error"] = source.picture(entry["pictures"]["error"])
    name = frame.name
    figures = entry["protocols"]["standard"]
    person = source.person(name)
    full = "".join(_figure(embed.image(p, f"{title}, frame {name}"), title) for title, p in pictures.items())
    crops = ""
    if person is not None:
        crops = "".join(
            _figure(embed.image(np.ascontiguousarray(person.crop(p)), f"{title}, person in frame {name}"))
            for title, p in pictures.items()
        )
    count = len(pictures)
    return (
        f'<article class="frame"><h3>Frame {escape(name)} '
        f"<small>{frame.mid_us / 1e6:.3f} s · exposure "
        f"{(frame.exposure_us[1] - frame.exposure_us[0]) / 1000:g} ms{_frame_figures(figures)}"
        f'</small></h3><div class="grid n{count}">{full}</div>'
        f'<div class="grid n{count} crops">{crops}</div></article>'
    )


def _frame_figures(figures: dict[str, dict[str, float | None]]) -> str:
    parts = [
        f"{title} {value:.2f} dB"
        for region, title in REGION_TITLES.items()
        if (value := figures[region]["psnr"]) is not None
    ]
    return " · " + " · ".join(parts) if parts else ""


def _event_maps(source: Source) -> str:
    events = source.metrics["events"]
    if events is None:
        reason = source.metrics["reasons"]["events"]
        return _section("Event maps", "", f'<p class="note">None: {escape(reason)}.</p>')
    embed = Embedder(lossless=True)
    pairs = []
    for pair in events["pairs"]:
        before, after = pair["frames"]
        similarity = pair["similarity"]
        shown = "–" if similarity is None else f"{similarity:.2f}"
        images = "".join(
            _figure(
                embed.image(source.picture(path), f"{kind} events, frames {before} to {after}"), kind
            )
            for kind, path in pair["pictures"].items()
        )
        pairs.append(
            f'<article class="pair"><h3>{escape(before)} → {escape(after)} <small>{pair["split"]}'
            f" · similarity {shown} · full colour at {pair['full_scale']:g} events</small></h3>"
            f'<div class="grid n2">{images}</div></article>'
        )
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
    return _section(
        "Event maps",
        f"Given: recorded events between two mid-exposures, summed with their sign. Rendered: "
        f"{scale}. Both of a pair in the same colours. Similarity is the cosine of the two maps: "
        f"{means}.",
        _legend(css_gradient(signed=True), "darker", "brighter", "events")
        + f'<div class="pairs">{"".join(pairs)}</div>',
    )


def _novel_views(source: Source) -> str:
    cameras = source.metrics["novel_views"]
    if not cameras:
        return ""
    camera_pixels = sum(source.capture.cameras[c].width * source.capture.cameras[c].height for c in cameras)
    embed = Embedder.for_pixels(camera_pixels * _NOVEL_SHOWN * 2)
    blocks = []
    for name, values in cameras.items():
        views = [view for view in source.capture.novel_views if view.camera == name]
        per_view = {entry["frame"]: entry for entry in values["per_view"]}
        pairs = []
        for view in _spread(views, _NOVEL_SHOWN):
            entry = per_view[view.frame]
            render = source.picture(entry["pictures"]["render"])
            truth = to_bytes(source.capture.novel_image(view))
            label = f"{name}, frame {view.frame}"
            pairs.append(
                '<article class="pair"><div class="grid n2">'
                + _figure(embed.image(render, f"render of {label}"), f"render · {entry['psnr']:.2f} dB")
                + _figure(embed.image(truth, f"truth of {label}"), f"truth · frame {view.frame}")
                + "</div></article>"
            )
        blocks.append(
            f"<h3>{escape(name)} <small>mean of {len(views)} views{_frame_figures(_with_mask(values))}"
            f'</small></h3><div class="pairs">{"".join(pairs)}</div>'
        )
    return _section(
        "Novel views",
        "Cameras that took no part in the training. One camera does not see what is behind the "
        "person or outside of its own picture, so that large errors there are expected.",
        "".join(blocks),
    )


def _with_mask(values: dict[str, Any]) -> dict[str, dict[str, float | None]]:
    return {**values, "person_mask": {"psnr": None}}


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
            [series("psnr", [entry.get("psnr") for entry in log])],
            x_title="iteration",
            y_title="PSNR of the training pictures, dB",
        ),
        line_chart(counts, x_title="iteration", y_title="Gaussians"),
    ]
    return _section("Curves", "", f'<div class="charts">{"".join(charts)}</div>')


def _configuration(source: Source) -> str:
    blocks = []
    loose = {k: v for k, v in source.config.items() if not isinstance(v, dict)}
    groups = {"run": loose} | {k: v for k, v in source.config.items() if isinstance(v, dict)}
    for group, values in groups.items():
        rows = "".join(
            f"<div><dt>{escape(key)}</dt><dd>{escape(_plain(value))}</dd></div>"
            for key, value in _flat(values)
        )
        if rows:
            blocks.append(f"<div class=group><h3>{escape(str(group))}</h3><dl>{rows}</dl></div>")
    versions = "".join(
        f"<div><dt>{escape(key)}</dt><dd>{escape(_plain(value))}</dd></div>"
        for key, value in _flat(source.versions)
    )
    if versions:
        blocks.append(f"<div class=group><h3>versions</h3><dl>{versions}</dl></div>")
    if not blocks:
        return ""
    return _section("Configuration", "", f'<div class="config">{"".join(blocks)}</div>')


def _footer(source: Source) -> str:
    return (
        "<footer><p>Capture <code>"
        f"{escape(source.metrics['capture'])}</code>: {escape(_provenance(source))}</p></footer>"
    )


def _provenance(source: Source) -> str:
    text = source.capture.provenance.get("text")
    return str(text) if text else "no provenance given."


def _section(title: str, intro: str, body: str) -> str:
    lead = f'<p class="intro">{intro}</p>' if intro else ""
    return f"<section><h2>{title}</h2>{lead}{body}</section>"


def _figure(image: str, caption: str = "") -> str:
    text = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
    return f"<figure>{image}{text}</figure>"


def _legend(gradient: str, low: str, high: str, what: str) -> str:
    return (
        f'<p class="scale"><span>{escape(what)}:</span><span>{escape(low)}</span>'
        f'<i style="background:{gradient}"></i><span>{escape(high)}</span></p>'
    )


def _spread(items: Sequence[_T], count: int) -> list[_T]:
    """At most ``count`` items, evenly spread, the first and the last among them."""
    if len(items) <= count:
        return list(items)
    return [items[round(i * (len(items) - 1) / (count - 1))] for i in range(count)]


def _flat(values: dict[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    """Nested settings as dotted keys."""
    result: list[tuple[str, Any]] = []
    for key, value in values.items():
        if isinstance(value, dict):
            result += _flat(value, f"{prefix}{key}.")
        else:
            result.append((f"{prefix}{key}", value))
    return result


def _plain(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, list | tuple):
        return ", ".join(_plain(item) if not isinstance(item, list) else f"({_plain(item)})" for item in value)
    return "–" if value is None else str(value)


def _count(value: Any) -> str | None:
    return None if value is None else f"{value:,}".replace(",", "\u202f")


def _duration(seconds: float | None) -> str | None:
    if seconds is None:
        return None
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes:02d} min"
    return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"
