"""When a recording is open to training: all of its time but the held-out intervals."""

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from itertools import accumulate

from evsplat.capture.metadata import Frame
from evsplat.events import ALWAYS, Span


def held_out_spans(frames: Sequence[Frame]) -> tuple[Span, ...]:
    """Held-out intervals, merged and in order of time, microseconds, ends exclusive.

    Each runs from the end of the last training exposure before a held-out frame to the start of the
    next training exposure after it; before and after are told by mid-exposures, since exposures may
    overlap. Without a training frame on a side it has no end there. No training exposure reaches
    into one, so that of overlapping exposures the training one is seen whole.
    """
    train = sorted((f for f in frames if f.split == "train"), key=lambda frame: frame.mid_us)
    mids = [frame.mid_us for frame in train]
    # Latest end of the first i training exposures, and earliest start of the others.
    ends = list(accumulate((f.exposure_us[1] for f in train), max, initial=ALWAYS[0]))
    starts = list(accumulate((f.exposure_us[0] for f in reversed(train)), min, initial=ALWAYS[1]))
    starts.reverse()
    spans = []
    for frame in frames:
        if frame.split == "train":
            continue
        start = ends[bisect_right(mids, frame.mid_us)]
        end = starts[bisect_left(mids, frame.mid_us)]
        if start < end:
            spans.append((start, end))
    merged: list[Span] = []
    for start, end in sorted(spans):
        if merged and start <= merged[-1][1]:
            merged[-1] = merged[-1][0], max(end, merged[-1][1])
        else:
            merged.append((start, end))
    return tuple(merged)


def open_spans(frames: Sequence[Frame]) -> tuple[Span, ...]:
    """What `held_out_spans` leave, in order of time; everything where nothing is held out."""
    edges = [ALWAYS[0]]
    for start, end in held_out_spans(frames):
        edges += [start, end]
    edges.append(ALWAYS[1])
    pairs = zip(edges[::2], edges[1::2], strict=True)
    return tuple((start, end) for start, end in pairs if start < end)
