"""The report page: complete, self-contained, safe with hostile names."""

import base64
import io
import json
import os
import re
from dataclasses import replace
from html.parser import HTMLParser
from types import SimpleNamespace

import av
import numpy as np
import pytest
from PIL import Image

from evsplat.capture import Policy, load_capture
from evsplat.capture.policy import Terms
from evsplat.config import to_dict
from evsplat.errors import ConfigError, DataError
from evsplat.evaluation import evaluate, run
from evsplat.evaluation.protocols import METRICS
from evsplat.evaluation.report.charts import Series, line_chart
from evsplat.evaluation.report.page import page
from evsplat.evaluation.report.source import Source
from evsplat.evaluation.splits import name_of
from evsplat.evaluation.tables import write_tables
from evsplat.files import write_json
from evsplat.pages import more

from .helpers import TruthWithNoise, drop, edit

HOSTILE = '<img src="https://example.org/x" onerror=alert(1)>&'
HOSTILE_NAME = '<img src="x" onerror=alert(1)>&'
"""Names have no separators."""


@pytest.fixture(autouse=True)
def without_perceptual_metric(monkeypatch):
    """ST-LPIPS is left out to be quick."""
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)


class Page(HTMLParser):
    """Elements with their attributes; checks that tags are balanced."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.text: list[str] = []
        self._open: list[str] = []
        self.feed(text)
        assert not self._open, self._open

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        if tag not in {"meta", "img", "input"}:
            self._open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self._open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)

    def count(self, tag: str) -> int:
        return sum(name == tag for name, _ in self.elements)


def evaluated(path, folder, *, training=True, alone=False, policy=None, change=None, split="test"):
    """An evaluated run of `TruthWithNoise`, as a source for the page.

    ``change`` is applied to the metrics before they are written.
    """
    capture = load_capture(path)
    if policy is not None and policy.use == "everything":
        capture = capture.with_nothing_held_out()
    reconstruction = TruthWithNoise(capture, 0.02)
    metrics = evaluate(capture, reconstruction, out_dir=folder, test_frames_only=alone, split=split)
    if policy is not None:
        metrics["policy"] = to_dict(policy)
    if change is not None:
        metrics = change(metrics)
    if training:
        facts = {"iteration": 12345, "train_seconds": 3723.4, "device": "cpu"}
        metrics |= facts | {"gaussians": {"human": 4321, "scene": 20}}
        entries = [
            {"iteration": i, "loss": 1 / i, "terms": {"l1": 0.5 / i}, "psnr": 20 + i, "human": i}
            for i in range(1, 9)
        ]
        lines = [json.dumps(entry | {"scene": 5}) for entry in entries]
        (folder / "log.jsonl").write_text("\n".join(lines) + '\n{"iteration": 9, "lo')
        (folder / "config.yaml").write_text(f"event: {{weight: 0.2, note: '{HOSTILE}'}}\nseed: 3\n")
        write_json(folder / "versions.json", {"torch": "2.13"})
    write_json(folder / name_of("metrics", split, ".json"), metrics)
    return Source.read(folder, capture, reconstruction, split)


def test_page_is_one_file_without_any_request_and_hostile_names_stay_text(tiny_capture, tmp_path):
    def change(document):
        document["name"] = HOSTILE_NAME
        document["provenance"]["text"] = HOSTILE

    text = page(evaluated(edit(tiny_capture(), change), tmp_path))
    parsed = Page(text)
    for tag, attributes in parsed.elements:
        assert tag not in {"script", "link", "iframe", "object", "embed"}
        for name, value in attributes.items():
            assert name != "onerror"
            if name in {"src", "href", "poster", "srcset", "action"}:
                assert value.startswith("data:")
    assert not re.search(r"url\(|@import", text)
    assert sum(HOSTILE_NAME in data for data in parsed.text) >= 2
    assert sum(HOSTILE in data for data in parsed.text) >= 2


@pytest.mark.parametrize(
    ("planned", "nominal", "said"),
    [
        (2000, 15_000.0, "12\u202f345, the whole schedule (planned for 2\u202f000)"),
        (40_000, 4_500.0, "12\u202f345, 30 % of the schedule (planned for 40\u202f000)"),
        (12_345, 15_000.0, "12\u202f345"),
        (2000, None, "12\u202f345"),
    ],
)
def test_steps_and_the_schedule_are_one_statement(tiny_capture, tmp_path, planned, nominal, said):
    """Steps of a shortened run stood beside the setting, which names the planned ones."""
    source = evaluated(tiny_capture(), tmp_path)
    last = {"iteration": 12345, "nominal": nominal}
    source = replace(source, config={"iterations": planned}, log=[*source.log, last])
    assert f"<dt>iterations</dt><dd>{said}</dd>" in page(source)


def test_page_of_a_trained_run_ends_with_commands_for_its_folder(tiny_capture, tmp_path):
    path, folder = tiny_capture(), tmp_path / "a <b> run"
    folder.mkdir()
    text = " ".join(Page(page(evaluated(path, folder))).text)
    for command in ("view", "render", "export"):
        assert f"evsplat {command} '{folder}'" in text
    other = tmp_path / "untrained"
    other.mkdir()
    assert "What to do next" not in page(evaluated(path, other, training=False))


def test_page_shows_films_and_links_pages_that_were_made_of_the_run(
    tiny_capture, tmp_path, monkeypatch
):
    monkeypatch.setattr("evsplat.evaluation.report.made._MOST_BYTES", 1000)
    renders, exports = tmp_path / "renders", tmp_path / "exports"
    (exports / "dancer").mkdir(parents=True)
    renders.mkdir()
    name = "<b>a"
    (renders / f"{name}.mp4").write_bytes(b"film" * 100)
    (renders / "b.webp").write_bytes(b"loop" * 100)
    (renders / "too large.mp4").write_bytes(b"long" * 1000)
    (renders / "notes.txt").write_bytes(b"no film")
    (renders / "outside.mp4").symlink_to("/etc/hostname")
    os.mkfifo(renders / "pipe.mp4")
    (exports / "avatar.html").touch()
    (exports / "dancer" / "index.html").touch()
    (exports / os.fsdecode(b"e?#%\xff.html")).touch()
    parsed = Page(page(evaluated(tiny_capture(), tmp_path)))
    sources = [str(attributes.get("src")) for _, attributes in parsed.elements]
    for kind, content in (("video/mp4", b"film" * 100), ("image/webp", b"loop" * 100)):
        assert f"data:{kind};base64,{base64.b64encode(content).decode()}" in sources
    links = [attributes["href"] for tag, attributes in parsed.elements if tag == "a"]
    places = [
        *("renders/too%20large.mp4", "exports/avatar.html"),
        *("exports/e%3F%23%25%FF.html", "exports/dancer/index.html"),
    ]
    assert [link for link in links if not link.startswith("#")] == places
    assert name in parsed.text and "b" in parsed.text
    assert "outside" not in parsed.text and "pipe" not in parsed.text


def test_page_shows_every_test_frame_pair_and_view(tiny_capture, tmp_path):
    source = evaluated(tiny_capture(frames=20), tmp_path)
    parsed = Page(page(source))
    alts = [attributes["alt"] for tag, attributes in parsed.elements if tag == "img"]
    for frame in source.capture.test_frames:
        for title in ("blurry input", "our render", "sharp truth", "error"):
            assert f"{title}, frame {frame.name}" in alts
    for pair in source.metrics["events"]["pairs"]:
        for kind in ("given", "rendered"):
            assert f"{kind} events, frames {pair['frames'][0]} to {pair['frames'][1]}" in alts
    assert sum(alt.startswith("render of side") for alt in alts) == 4
    text = " ".join(parsed.text)
    for shown in ("median background", "12\u202f345", "1 h 02 min", "4\u202f321", "2.13", "weight"):
        assert shown in text
    # loss and two terms' sum, PSNR, two counts; PSNR by frame of two rows, and the speed
    assert parsed.count("polyline") == 8
    assert sum(attributes.get("type") == "range" for _, attributes in parsed.elements) == 2 * len(
        source.capture.test_frames
    )


def test_one_frame_and_one_view_are_told_in_the_singular(tiny_capture, tmp_path):
    source = evaluated(tiny_capture(frames=8), tmp_path)
    assert len(source.capture.test_frames) == len(source.capture.novel_views) == 1
    text = " ".join(Page(page(source)).text)
    assert "Means over 1 held-out frame against" in text and "mean of 1 view" in text
    write_tables(tmp_path, source.metrics)
    assert "Means over 1 held-out frame against" in (tmp_path / "metrics.md").read_text("utf-8")
    told = (text, (tmp_path / "metrics.md").read_text("utf-8"), more(1, 1, "pair"))
    wrong = re.compile(r"\b1 (?:\S+ )?(?:frame|view|pair)s")
    assert not [one for one in told if wrong.search(one)]
    assert more(1, 3, "pair") == "1 of 3 more pairs"


@pytest.mark.parametrize("split", ["test", "train"])
def test_pictures_that_are_taken_as_sharp_are_not_called_blurry(tiny_capture, tmp_path, split):
    def change(document):
        for frame in document["frames"]:
            frame["sharp"] = frame["image"]

    parsed = Page(page(evaluated(edit(tiny_capture(), change), tmp_path, split=split)))
    alts = [attributes.get("alt") or "" for tag, attributes in parsed.elements if tag == "img"]
    sliders = [a["aria-label"] for _, a in parsed.elements if a.get("type") == "range"]
    assert set(sliders) == {"recorded picture, taken as sharp | our render"}
    assert "recorded picture, taken as sharp, frame 0007" in alts or split == "train"
    # It is not shown a second time as the truth that it is.
    assert not any(alt.startswith(("blurry", "sharp truth")) for alt in alts)
    assert "blurry" not in " ".join(parsed.text)
    assert any(alt.startswith("error") for alt in alts)


def test_page_of_training_frames_says_so(tiny_capture, tmp_path):
    everything = Policy(use="everything")
    source = evaluated(tiny_capture(frames=20), tmp_path, split="train", policy=everything)
    parsed = Page(page(source))
    text = " ".join(parsed.text)
    for said in ("20 training frames against", "on training frames", "Training frames", "saw it"):
        assert said in text
    for wrong in ("held-out", "Held-out", "Test frames", "no test figures"):
        assert wrong not in text
    alts = [attributes["alt"] for tag, attributes in parsed.elements if tag == "img"]
    assert "our render, frame 0000" in alts
    with pytest.raises(DataError, match="metrics.json: file not found"):
        Source.read(tmp_path, source.capture, source.reconstruction)
    (tmp_path / "metrics_train.json").unlink()
    with pytest.raises(DataError, match="first run evsplat evaluate .* --split train"):
        Source.read(tmp_path, source.capture, source.reconstruction, "train")


def test_embedded_pictures_are_the_pictures(tiny_capture, tmp_path):
    source = evaluated(tiny_capture(), tmp_path)
    name = source.capture.test_frames[0].name
    for tag, attributes in Page(page(source)).elements:
        if tag == "img" and attributes["alt"] == f"sharp truth, frame {name}":
            content = base64.b64decode(attributes["src"].split(",")[1])
            picture = np.asarray(Image.open(io.BytesIO(content)).convert("RGB"))
            expected = np.asarray(Image.open(source.capture.path / "sharp" / f"{name}.png"))
            assert np.array_equal(picture, expected)
            break
    else:
        raise AssertionError("the truth is not on the page")


def test_clip_plays_both_halves_in_slow_motion(tiny_capture, tmp_path):
    source = evaluated(tiny_capture(), tmp_path)
    (video,) = (a for tag, a in Page(page(source)).elements if tag == "video")
    with av.open(io.BytesIO(base64.b64decode(video["src"].split(",")[1]))) as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    # nine periods of 40 ms, five times slower, at 25 pictures per second
    assert len(frames) == round(0.36 * 5 * 25)
    scale = frames[0].shape[0] // 24
    assert scale > 1 and frames[0].shape == (24 * scale, (2 * 32 + 1) * scale, 3)
    left = frames[0][:, : 32 * scale][scale // 2 :: scale, scale // 2 :: scale]
    blurry = (source.capture.image(source.capture.frames[0]) * 255).numpy()
    assert np.abs(left - blurry).mean() < 8


def test_page_of_a_method_without_training_or_truth_or_events(tiny_capture, tmp_path):
    def change(document):
        document.pop("events")
        document["novel_views"] = []
        drop("sharp", "mask")(document)

    parsed = Page(page(evaluated(edit(tiny_capture(), change), tmp_path, training=False)))
    text = " ".join(parsed.text)
    assert "no sharp ground truth" in text and "no events" in text
    assert "Novel views" not in text and "Curves" not in text
    alts = [attributes["alt"] for tag, attributes in parsed.elements if tag == "img"]
    assert any("our render" in alt for alt in alts) and not any("truth" in alt for alt in alts)


def test_report_needs_an_evaluation(tiny_capture, tmp_path, monkeypatch):
    capture = load_capture(tiny_capture())
    reconstruction = TruthWithNoise(capture)
    trained = SimpleNamespace(capture=capture, reconstruction=reconstruction, iteration=12345)
    monkeypatch.setattr(run, "load_run", lambda path: trained)
    (tmp_path / "config.yaml").touch()
    with pytest.raises(DataError, match="evsplat evaluate"):
        run.write_report(tmp_path)
    evaluated(capture.path, tmp_path)
    path = run.write_report(tmp_path)
    assert path == tmp_path / "report.html" and path.stat().st_size > 10_000


@pytest.mark.parametrize("name", ["metrics.json", "versions.json"])
def test_a_broken_file_of_the_run_is_one_sentence(tiny_capture, tmp_path, name):
    source = evaluated(tiny_capture(), tmp_path)
    for content in (b"{", b"[" * 100_000, b"[1]", b"\xff"):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(DataError, match=rf"{name}: "):
            Source.read(tmp_path, source.capture, source.reconstruction)


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ('{"loss": 1}', "it has no iteration"),
        ('{"iteration": 9, "loss": "abc"}', "loss is 'abc', expected a number or null"),
        ('{"iteration": 9, "terms": [1]}', "terms is [1], expected an object"),
        ('{"iteration": 9, "human": 1e308}', "human is 1e+308, expected a number or null"),
    ],
)
def test_line_of_the_log_that_no_training_wrote_is_named(tiny_capture, tmp_path, line, said):
    """To evaluate again, as is said of other figures, would leave it where it is."""
    source = evaluated(tiny_capture(), tmp_path)
    with (tmp_path / "log.jsonl").open("a") as log:
        log.write(f"\n{line}\n")
    with pytest.raises(DataError) as error:
        Source.read(tmp_path, source.capture, source.reconstruction)
    assert str(error.value) == f"{tmp_path / 'log.jsonl'}: line 10: {said}; remove the line."


def test_lines_of_the_log_that_are_broken_or_deep_are_left_out(tiny_capture, tmp_path):
    source = evaluated(tiny_capture(), tmp_path)
    with (tmp_path / "log.jsonl").open("a") as log:
        log.write("\n" + "[" * 100_000 + "\n[1]\n")
    read = Source.read(tmp_path, source.capture, source.reconstruction)
    assert read.log == source.log and len(read.log) == 8
    (tmp_path / "log.jsonl").write_bytes(b"\xff")
    with pytest.raises(DataError, match="log.jsonl: not a text"):
        Source.read(tmp_path, source.capture, source.reconstruction)
    (tmp_path / "log.jsonl").unlink()
    (tmp_path / "config.yaml").write_text("a: [")
    with pytest.raises(ConfigError, match="config.yaml: not valid YAML"):
        Source.read(tmp_path, source.capture, source.reconstruction)


def points(svg: str) -> list[list[tuple[float, float]]]:
    return [
        [tuple(map(float, pair.split(","))) for pair in line.split()]
        for line in re.findall(r'points="([^"]*)"', svg)
    ]


def test_chart_places_values_linearly_and_skips_what_has_no_logarithm():
    line = Series("a", [0, 1, 2], [1.0, 2.0, 4.0])
    (linear,) = points(line_chart([line], x_title="x", y_title="y"))
    (x0, y0), (x1, y1), (x2, y2) = linear
    assert x1 - x0 == pytest.approx(x2 - x1, abs=0.11)
    assert y1 - y2 == pytest.approx(2 * (y0 - y1), abs=0.31)
    (log,) = points(line_chart([line], x_title="x", y_title="y", log=True))
    assert log[0][1] - log[1][1] == pytest.approx(log[1][1] - log[2][1], abs=0.11)
    gaps = Series("b", [0, 1, 2, 3], [1.0, 0.0, float("nan"), 2.0])
    assert len(points(line_chart([gaps], x_title="x", y_title="y", log=True))[0]) == 2


@pytest.mark.parametrize("values", [[3.0], [2.0, 2.0], [0.0, 0.0], [1e-9, 1e9], [-5.0, -5.0]])
@pytest.mark.parametrize("log", [False, True])
def test_chart_of_any_range_is_finite(values, log):
    svg = line_chart([Series("<a>", range(len(values)), values)], x_title="x", y_title="y", log=log)
    assert "nan" not in svg and "inf" not in svg and "<a>" not in svg


@pytest.mark.parametrize("log", [False, True])
@pytest.mark.parametrize("start", [1e-4, 30.0, 1234.5, 1e6, 1.7e9])
@pytest.mark.parametrize("width", [1e-3, 0.03, 0.9])
def test_no_two_ticks_of_a_chart_say_the_same(start, width, log):
    """As those of 2 s of a recording whose clock began 20 minutes before."""
    span = width * (start if log or start < 1 else 1)
    ends = [start, start + span]
    svg = line_chart([Series("a", ends, ends)], x_title="x", y_title="y", log=log)
    ticks = re.findall(
        r'<text class="tick" x="[^"]*" y="([^"]*)" text-anchor="(\w+)">([^<]*)<', svg
    )
    for anchor in ("middle", "end"):
        labels = [said for _, where, said in ticks if where == anchor and said not in "xy"]
        values = [1000 * float(said[:-1]) if said[-1] == "k" else float(said) for said in labels]
        # Of decimal logarithms one may lie in the range; that of abscissae is always linear.
        assert len(labels) > (1 if anchor == "middle" or not log else 0)
        assert values == sorted(set(values))
        assert all(start - span < value < start + 2 * span for value in values)


def test_long_series_are_averaged():
    noisy = Series("noisy", range(100_000), [i % 2 for i in range(100_000)])
    scale = Series("scale", [0, 1], [0, 1])
    line, (low, high) = points(line_chart([noisy, scale], x_title="x", y_title="y"))
    assert len(line) <= 300
    middle, height = (low[1] + high[1]) / 2, low[1] - high[1]
    assert all(abs(y - middle) < 0.01 * height for _, y in line)


def test_page_of_a_capture_without_test_frames(tiny_capture, tmp_path):
    path = edit(tiny_capture(), lambda d: [f.update(split="train") for f in d["frames"]])
    text = " ".join(Page(page(evaluated(path, tmp_path))).text)
    assert "No frame has split" in text and "sharp ground truth" not in text


def test_page_of_a_training_on_everything_has_novel_views_but_nothing_held_out(
    tiny_capture, tmp_path
):
    source = evaluated(tiny_capture(), tmp_path, policy=Policy(use="everything"))
    parsed = Page(page(source))
    text = " ".join(parsed.text)
    # the headline, the figures and the test frames
    assert text.lower().count("trained on every frame and every event") == 3
    assert "Held" not in text and "held-out" not in text and "None" not in text
    alts = [attributes["alt"] for tag, attributes in parsed.elements if tag == "img"]
    assert any(alt.startswith("render of side") for alt in alts)
    assert not any("our render" in alt for alt in alts)
    assert not any(attributes.get("class") == "card" for _, attributes in parsed.elements)


def test_page_of_a_run_without_a_policy_claims_nothing_of_its_training(tiny_capture, tmp_path):
    path = tiny_capture()
    text = " ".join(Page(page(evaluated(path, tmp_path / "old"))).text)
    assert text.count("othing tells what training saw") == 2
    source = evaluated(path, tmp_path / "new", policy=Policy())
    text = " ".join(Page(page(source)).text)
    assert Terms().sentence(3) in text and "no event of the intervals around them" in text
    assert "othing tells" not in text


def without_figures(value):
    """The same metrics, but nothing could be measured."""
    if isinstance(value, dict):
        figures = {*METRICS, "psnr_person_crop", "similarity"}
        return {
            key: None if key in figures and not isinstance(entry, dict) else without_figures(entry)
            for key, entry in value.items()
        }
    return [without_figures(entry) for entry in value] if isinstance(value, list) else value


def test_page_of_figures_that_are_all_missing(tiny_capture, tmp_path):
    def change(metrics):
        metrics["events"]["mean_similarity"] = {"test": None, "train": None}
        return without_figures(metrics)

    parsed = Page(page(evaluated(tiny_capture(), tmp_path, change=change)))
    text = " ".join(parsed.text)
    assert "None" not in text and "cosine of the two maps." in text
    alts = [attributes["alt"] for tag, attributes in parsed.elements if tag == "img"]
    assert any(alt.startswith("render of side") for alt in alts)
    assert any("our render" in alt for alt in alts)


def test_page_of_an_evaluation_alone_compares_with_nothing(tiny_capture, tmp_path):
    source = evaluated(tiny_capture(), tmp_path, alone=True)
    assert "blurry_input" not in source.metrics
    parsed = Page(page(source))
    text = " ".join(parsed.text)
    assert "trivial" not in text and "above" not in text and "blurry input itself" not in text
    assert "None: they were not evaluated" in text
    assert sum(attributes.get("class") == "card" for _, attributes in parsed.elements) == 3
