"""What the report holds figures against and what it says of a training, with made-up figures."""

from html.parser import HTMLParser
from types import SimpleNamespace

import pytest

from evsplat.capture import Policy
from evsplat.capture.policy import Terms, terms_of
from evsplat.config import to_dict
from evsplat.evaluation.protocols import METRICS, REGIONS
from evsplat.evaluation.report import frames
from evsplat.evaluation.report.figures import distance, figures, references
from evsplat.evaluation.report.page import _summary

EVERYTHING = (
    "trained on every frame and every event (--use everything): nothing was held out, so there "
    "are no test figures."
)


class Text(HTMLParser):
    """The paragraphs of a page, each under its class, and all that is read."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.read = ""
        self.paragraphs: list[tuple[str | None, str]] = []
        self._inside = False
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        if tag == "p":
            self._inside = True
            self.paragraphs.append((dict(attrs).get("class"), ""))

    def handle_endtag(self, tag):
        self._inside = self._inside and tag != "p"

    def handle_data(self, data):
        self.read += data
        if self._inside:
            kind, text = self.paragraphs[-1]
            self.paragraphs[-1] = kind, text + data

    def of(self, *kinds: str) -> list[tuple[str | None, str]]:
        """The paragraphs of these classes."""
        return [paragraph for paragraph in self.paragraphs if paragraph[0] in kinds]


def row(*values: float | None) -> dict[str, dict[str, float | None]]:
    """PSNR by region: full frame, person crop, person mask; nothing else is known."""
    return {
        region: dict.fromkeys(METRICS) | {"psnr": value}
        for region, value in zip(REGIONS, values, strict=True)
    }


UNKNOWN = row(None, None, None)


def made_up(ours, median, nearest, camera, *, policy: Policy | None = None, test: int = 3):
    """The metrics of a method and its three other rows; no pictures."""
    metrics = {
        "capture": "made up",
        "method": "ours",
        "frames": {"train": 7, "test": test},
        "protocols": {"standard": ours},
        "trivial": {"median_background": median, "nearest_frame": nearest},
        "blurry_input": camera,
        "compat_rows": {},
        "blurry_ground_truth": UNKNOWN,
        "per_frame": [{}] * test,
        "reasons": {},
        "weights": {},
        "protocol_notes": {"standard": "a note"},
    }
    return metrics if policy is None else metrics | {"policy": to_dict(policy)}


def alone(metrics):
    """What an evaluation without other rows leaves."""
    other = {"trivial", "blurry_input", "compat_rows", "blurry_ground_truth"}
    return {key: value for key, value in metrics.items() if key not in other}


def headline(metrics) -> str:
    return Text(f"<p>{_summary(metrics)}</p>").read.replace("\xa0", " ")


def cards(metrics) -> list[tuple[str | None, str]]:
    return Text(figures(SimpleNamespace(metrics=metrics))).of("up", "down")


# The median is the better row on the full frame, the nearest frame on the person, and the camera's
# picture is beaten on the full frame alone.
MIXED = made_up(
    row(38.5, 33.2, 24.0), row(32.4, 20.0, 13.0), row(31.0, 30.1, 25.5), row(34.5, 37.3, 30.25)
)


def test_the_headline_holds_each_region_against_the_same_region_of_both_references():
    assert headline(MIXED) == (
        "ours reaches 38.50 dB on held-out frames (6.1 dB above the best picture that needs no "
        "method, 4.0 dB above the camera’s own blurry picture), "
        "33.20 dB on the person’s crop (3.1 dB above the best without a method, "
        "4.1 dB below the camera’s own), "
        "24.00 dB on the person’s mask (1.5 dB below the best without a method, "
        "6.2 dB below the camera’s own)."
    )


def test_the_cards_hold_each_region_against_the_same_region_of_both_references():
    trivial, camera = "the best trivial row", "the camera’s own blurry picture"
    assert cards(MIXED) == [
        ("up", f"6.10 dB above {trivial}"),
        ("up", f"4.00 dB above {camera}"),
        ("up", f"3.10 dB above {trivial}"),
        ("down", f"4.10 dB below {camera}"),
        ("down", f"1.50 dB below {trivial}"),
        ("down", f"6.25 dB below {camera}"),
    ]


@pytest.mark.parametrize(
    ("ours", "theirs", "said"),
    [
        (30.0, 28.76, "1.2 dB above"),
        (28.76, 30.0, "1.2 dB below"),
        (30.0, 30.0, "level with"),
        (30.0, 29.96, "level with"),
        (29.94, 30.0, "0.1 dB below"),
    ],
)
def test_a_distance_is_told_alike_in_both_directions(ours, theirs, said):
    assert distance(ours, theirs, 1) == said


def test_references_that_were_not_measured_are_not_told():
    ours = row(30.0, 25.0, None)
    without_mask = made_up(ours, row(20.0, 15.0, None), UNKNOWN, row(32.0, 26.0, None))
    assert references(without_mask, "person_mask") == {}
    assert references(without_mask, "full") == {"trivial": 20.0, "camera": 32.0}
    assert "mask" not in headline(without_mask) and len(cards(without_mask)) == 4
    no_rows = made_up(ours, UNKNOWN, UNKNOWN, row(32.0, 26.0, None))
    assert headline(no_rows) == (
        "ours reaches 30.00 dB on held-out frames (2.0 dB below the camera’s own blurry picture), "
        "25.00 dB on the person’s crop (1.0 dB below the camera’s own)."
    )
    nothing_else = alone(made_up(ours, UNKNOWN, UNKNOWN, UNKNOWN))
    assert headline(nothing_else) == (
        "ours reaches 30.00 dB on held-out frames, 25.00 dB on the person’s crop."
    )
    assert cards(nothing_else) == []


def test_without_truth_there_are_neither_cards_nor_a_table():
    metrics = made_up(UNKNOWN, UNKNOWN, UNKNOWN, UNKNOWN)
    page = figures(SimpleNamespace(metrics=metrics))
    assert "card" not in page and "<table" not in page
    assert "none has a sharp picture" in page and "Means" not in page
    assert "no sharp ground truth" in headline(metrics)


@pytest.mark.parametrize("held_out_events", [False, True])
@pytest.mark.parametrize("held_out_poses", ["given", "interpolated"])
def test_what_training_saw_is_told_beside_the_figures_and_the_test_frames(
    held_out_events, held_out_poses
):
    terms = Terms(held_out_events=held_out_events, held_out_poses=held_out_poses)
    metrics = MIXED | {"policy": to_dict(terms)}
    ((_, intro),) = Text(figures(SimpleNamespace(metrics=metrics))).of("intro")
    assert terms.sentence(metrics["frames"]["test"]) in intro
    told = frames._held_out_terms(terms_of(metrics))
    assert "neither picture nor mask" in told
    assert ("and no event of the intervals" in told) == (not held_out_events)
    assert ("but the events of the intervals" in told) == held_out_events
    assert ("poses there were given" in told) == (held_out_poses == "given")
    assert ("poses there were interpolated" in told) == (held_out_poses == "interpolated")


@pytest.mark.parametrize("use", ["training", "everything"])
def test_of_events_that_were_not_recorded_nothing_else_is_said(use):
    terms = Terms(use=use, thresholds="estimated", events=False)
    metrics = MIXED | {"policy": to_dict(terms)}
    said = [terms.sentence(held_out) for held_out in (0, 3)]
    said += [frames._held_out_terms(terms_of(metrics)), *terms.departures]
    said += [text for _, text in Text(figures(SimpleNamespace(metrics=metrics))).of("intro")]
    assert not [text for text in said if "threshold" in text or "interval" in text]
    assert not [text for text in said if "event" in text and "has no events" not in text]
    assert any("the recording has no events" in text for text in said) == (use == "training")


def test_a_run_that_does_not_tell_what_training_saw_is_said_not_to():
    ((_, intro),) = Text(figures(SimpleNamespace(metrics=MIXED))).of("intro")
    assert "Nothing tells what training saw." in intro
    told = frames._held_out_terms(terms_of(MIXED))
    assert "nothing tells what training saw" in told
    for claim in ("picture", "mask", "event", "pose"):
        assert claim not in told


@pytest.mark.parametrize("left", [0, 3], ids=["no test frame", "frames that look held out"])
def test_where_everything_trained_words_stand_in_place_of_figures(left):
    values = (row(38.5, 33.2, 24.0),) * 4 if left else (UNKNOWN,) * 4
    metrics = made_up(*values, policy=Policy(use="everything"), test=left)
    assert headline(metrics) == f"ours: {EVERYTHING}"
    for section in (figures, frames.test_frames):
        page = section(SimpleNamespace(metrics=metrics))
        assert EVERYTHING[1:] in Text(page).read
        assert "dB" not in page and "card" not in page and "<table" not in page


def test_a_capture_without_test_frames_is_not_said_to_lack_truth():
    metrics = made_up(*(UNKNOWN,) * 4, policy=Policy(), test=0)
    assert headline(metrics) == "ours: no frame has split “test”, so there are no test figures."
    for section in (figures, frames.test_frames):
        page = section(SimpleNamespace(metrics=metrics))
        assert "No frame has split “test”" in page
        assert "card" not in page and "<table" not in page and "Held" not in page
