"""What a training may see of a capture: asked for anything else, it raises and says why."""

import json

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from evsplat.capture import Frame, Policy, load_body_track, load_capture
from evsplat.capture.policy import Terms, terms_of
from evsplat.capture.training_capture import held_out_spans, readable_spans
from evsplat.errors import ConfigError, DataError, HeldOutError
from evsplat.events import ALWAYS
from evsplat.masks import MASKERS

from ..conftest import EXPOSURE_US, PERIOD_US
from ..seen import seen

LOW, HIGH = ALWAYS


def frames(splits: str, longer_us: int = 0) -> list[Frame]:
    """A frame every 40 ms, 30 ms long; ``x`` is held out."""
    return [
        Frame(
            str(index), index, "main", f"{index}.png",
            (index * PERIOD_US - longer_us, index * PERIOD_US + EXPOSURE_US + longer_us),
            "test" if split == "x" else "train",
        )
        for index, split in enumerate(splits)
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("splits", "expected"),
    [
        ("...", []),
        ("..x..", [(70_000, 120_000)]),
        ("..xx..", [(70_000, 160_000)]),
        (".x.x.", [(30_000, 80_000), (110_000, 160_000)]),
        ("x..", [(LOW, 40_000)]),
        ("..x", [(70_000, HIGH)]),
        ("xx", [(LOW, HIGH)]),
    ],
)
def test_a_held_out_interval_lies_between_the_training_exposures_around_it(splits, expected):
    assert held_out_spans(frames(splits)) == tuple(expected)


def test_of_overlapping_exposures_the_training_one_is_seen_whole():
    # exposures of 50 ms every 40 ms
    assert held_out_spans(frames("..x..", longer_us=10_000)) == ((80_000, 110_000),)
    # those before and after meet: nothing is left to hide but the picture
    assert held_out_spans(frames("..x..", longer_us=25_000)) == ()


@given(st.text(".x", min_size=1, max_size=12), st.integers(0, 20_000), st.integers(-1, 12))
def test_every_time_is_open_or_held_out_and_training_exposures_are_open(splits, longer_us, index):
    recorded = frames(splits, longer_us)
    closed, opened = held_out_spans(recorded), readable_spans(recorded)
    time = index * 37_000 + 11
    assert sum(start <= time < end for start, end in (*closed, *opened)) == 1
    for frame in recorded:
        start, end = frame.exposure_us
        if frame.split == "train":
            assert any(low <= start and end <= high for low, high in opened)


def test_what_is_hidden_raises_and_what_trains_does_not(tiny_capture):
    whole = load_capture(tiny_capture(frames=20))
    capture = seen(whole)
    trains, held_out = capture.train_frames[0], capture.held_out_frames[0]
    assert [f.name for f in capture.held_out_frames] == [f.name for f in whole.test_frames]
    torch.testing.assert_close(capture.image(trains), whole.image(trains))
    torch.testing.assert_close(capture.camera(held_out).K, whole.camera(held_out).K)
    for ask, says in (
        (lambda: capture.image(held_out), "picture of frame '0007'"),
        (lambda: capture.sharp(trains), "evaluation only"),
        (lambda: capture.mask(trains), "policy.masks=given"),
        (lambda: seen(whole, masks="given").mask(held_out), "mask of frame '0007'"),
        (lambda: capture.novel_views, "novel views"),
        (lambda: capture.dense_body_file, "body_dense"),
        (lambda: load_body_track(capture, dense=True), "body_dense"),
    ):
        with pytest.raises(HeldOutError, match=says):
            ask()
    given_masks = seen(whole, masks="given")
    torch.testing.assert_close(given_masks.mask(trains), whole.mask(trains))
    assert all(f.sharp is None and f.mask is None for f in capture.frames)
    assert capture.contrast_threshold == whole.contrast_threshold
    assert seen(whole, thresholds="estimated").contrast_threshold is None


def test_events_are_read_within_open_stretches_only(tiny_capture):
    whole = load_capture(tiny_capture(frames=20))
    events, all_events = seen(whole).events, whole.events
    train = whole.train_frames
    last, following = train[6].exposure_us[1], train[7].exposure_us[0]
    assert events.readable_around(train[3].mid_us) == (LOW, last)
    assert len(events.between(0, last)) == len(all_events.between(0, last)) > 0
    for start, end in ((last - 10, last + 1), (last, last + 1), (0, 700_000), (last, following)):
        with pytest.raises(HeldOutError, match="policy.held_out_events=true"):
            events.between(start, end)
    assert len(events.between(last + 5, last + 5)) == 0  # nothing is asked
    with pytest.raises(HeldOutError):
        events.readable_around(last + 10_000)
    with pytest.raises(HeldOutError):
        events.rate(10)
    stretches = events.stretches_us
    assert len(events) == sum(len(all_events.between(*span)) for span in stretches)
    assert events.time_range_us == (stretches[0][0], stretches[-1][1])
    assert len(seen(whole, held_out_events=True).events) == len(all_events)
    assert all_events.stretches_us == (all_events.time_range_us,)


def test_polarity_of_hidden_events_is_not_told(tiny_capture):
    import h5py

    path = tiny_capture(frames=10)
    whole = load_capture(path)
    last = whole.train_frames[6].exposure_us[1]
    with h5py.File(path / "events.h5", "r+") as file:
        polarity = file["events/p"][:]
        polarity[file["events/t"][:] < last] = 0
        file["events/p"][:] = polarity
    assert load_capture(path).events.has_polarity
    assert not seen(path).events.has_polarity
    assert not seen(path).events.between(0, last).p.any()


@pytest.mark.parametrize("seed", range(3))
def test_of_a_held_out_frame_its_own_key_pose_passes(tiny_capture, seed):
    """Keys every 5 ms or so: of those inside the interval the two around mid-exposure stay."""
    path = tiny_capture(frames=20)
    rng = np.random.default_rng(seed)
    body = dict(np.load(path / "body.npz"))
    times = np.unique(rng.integers(0, 800_000, 160))
    body |= {
        "times_us": times,
        "poses": rng.normal(size=(len(times), 3, 3)).astype(np.float32) * 0.1,
        "transl": np.zeros((len(times), 3), np.float32),
        "pose_std_rad": rng.random((len(times), 3)),
        "transl_std_m": rng.random((len(times), 3)),
    }
    np.savez(path / "body.npz", **body)
    document = json.loads((path / "capture.json").read_text())
    document["body"]["source"] = "markers"
    (path / "capture.json").write_text(json.dumps(document))
    capture = seen(path)
    kept = capture.body_file.times_us
    spans = held_out_spans(capture.frames)
    inside = [t for t in times if any(start <= t < end for start, end in spans)]
    around = set()
    for frame in capture.held_out_frames:
        around |= {max(times[times <= frame.mid_us]), min(times[times >= frame.mid_us])}
    assert set(times) - set(kept) == set(inside) - around
    assert len(set(inside) - around) > 10
    interpolated = seen(path, held_out_poses="interpolated").body_file
    assert set(times) - set(interpolated.times_us) == set(inside)
    kept = np.isin(times, interpolated.times_us)
    assert np.array_equal(interpolated.poses, body["poses"][kept])
    assert np.array_equal(interpolated.pose_std_rad, body["pose_std_rad"][kept])
    assert np.array_equal(interpolated.errors.root_m, body["transl_std_m"][kept])


def test_poses_at_test_times_are_interpolated_where_the_policy_says_so(tiny_capture):
    path = tiny_capture(frames=20)
    given_track, track = (
        load_body_track(seen(path, held_out_poses=kind)) for kind in ("given", "interpolated")
    )
    held_out, trains = seen(path).held_out_frames[1], seen(path).train_frames[3]
    assert not torch.allclose(
        given_track.bones([held_out.mid_us]), track.bones([held_out.mid_us]), atol=1e-3
    )
    torch.testing.assert_close(given_track.bones([trains.mid_us]), track.bones([trains.mid_us]))


def test_a_recording_whose_every_pose_is_hidden_is_refused(tiny_capture):
    path = tiny_capture(frames=10)
    document = json.loads((path / "capture.json").read_text())
    for index, frame in enumerate(document["frames"]):
        frame["split"] = "test" if index % 2 else "train"
    (path / "capture.json").write_text(json.dumps(document))
    body = dict(np.load(path / "body.npz"))
    body["times_us"] = body["times_us"] + EXPOSURE_US // 2 + 1_000  # just behind the exposures
    np.savez(path / "body.npz", **body)
    with pytest.raises(DataError, match="every key pose lies in a held-out interval"):
        _ = seen(path, held_out_poses="interpolated").body_file


def test_everything_trains_where_it_is_asked_for(tiny_capture):
    whole = load_capture(tiny_capture(frames=10))
    capture = seen(whole, use="everything", masks="given")
    assert len(capture.train_frames) == 10 and not capture.held_out_frames
    torch.testing.assert_close(capture.image("0008"), whole.image("0008"))
    assert len(capture.events.between(*capture.events.time_range_us)) == len(whole.events)
    assert not whole.with_nothing_held_out().test_frames
    with pytest.raises(HeldOutError):
        capture.sharp("0008")


def test_estimated_masks_are_the_maskers_own(tiny_capture):
    whole = load_capture(tiny_capture(frames=12, width=64, height=48))
    capture = whole.for_training(Policy(masks="estimated"), MASKERS["background"])
    masker = MASKERS["background"](seen(whole))
    for frame, mask in masker.masks(seen(whole), seen(whole).train_frames):
        torch.testing.assert_close(capture.mask(frame), mask)
    assert capture.has_mask("0000") and not capture.has_mask("0007")


def test_terms_say_what_the_recording_could_not_give(tiny_capture):
    path = tiny_capture()
    assert seen(path, masks="given").terms() == Terms(masks="given")
    document = json.loads((path / "capture.json").read_text())
    document["events"]["contrast_threshold"] = None
    document["provenance"]["masks"] = {"with": "background"}
    (path / "capture.json").write_text(json.dumps(document))
    assert seen(path, masks="given").terms() == Terms(masks="estimated", thresholds="estimated")
    del document["events"]
    (path / "capture.json").write_text(json.dumps(document))
    assert not seen(path).terms().events


def test_terms_say_of_thresholds_what_a_method_makes_of_them(tiny_capture):
    path = tiny_capture()
    given = seen(path)
    hidden = seen(path, thresholds="estimated", held_out_events=True)
    said = {
        ("amounts", True): "contrast thresholds estimated",
        ("amounts", False): "contrast thresholds unknown",
        ("direction", True): "contrast thresholds not used",
        ("nothing", True): "no events used",
    }
    for (use, found), departure in said.items():
        terms = hidden.terms(use, thresholds_found=found)
        asks = use != "nothing"
        seen_too = ("events of held-out intervals seen",) if asks else ()
        assert terms.departures == (*seen_too, departure)
        assert ("events of held-out intervals were seen" in terms.sentence(3)) == asks
        estimated = departure == "contrast thresholds estimated"
        assert ("estimated from training frames" in terms.sentence(3)) == estimated
        assert given.terms(use, thresholds_found=found).departures == ()
    assert "a usual one was taken" in hidden.terms(thresholds_found=False).sentence(3)
    assert "the method uses no events, no masks" in hidden.terms("nothing").sentence(3)
    document = json.loads((path / "capture.json").read_text())
    document["provenance"]["restored"] = {"with": "edi", "contrast_threshold": [0.2, 0.2]}
    (path / "capture.json").write_text(json.dumps(document))
    # Pictures that thresholds have sharpened show them to whoever asks for pictures alone.
    assert seen(path).terms("nothing") == Terms()


def test_neighbours_end_at_held_out_frames(tiny_capture):
    capture = seen(tiny_capture(frames=20))
    for frame in capture.train_frames:
        first = 0 if frame.index < 7 else 10
        assert [f.index for f in capture.neighbours(frame)] == list(range(first, first + 7))


@pytest.mark.parametrize(
    "misspelt",
    [
        {"use": "all"},
        {"thresholds": "Estimated"},
        {"masks": None},
        {"held_out_events": "no"},
        {"held_out_poses": "hidden"},
    ],
)
def test_a_policy_is_of_words_that_there_are(misspelt):
    ((name, value),) = misspelt.items()
    said = f"--{name.replace('_', '-')} '?{value}'?"
    with pytest.raises(ConfigError, match=f"{said}: expected "):
        Policy(**misspelt)
    with pytest.raises(ValueError, match="expected "):  # of a file: no option of its reader's
        terms_of({"policy": misspelt})
