"""Markdown and LaTeX tables."""

import pytest

from evsplat.evaluation.protocols import METRICS, REGIONS
from evsplat.evaluation.tables import (
    Figure,
    Heading,
    Row,
    Table,
    latex,
    missing_networks,
    tables_of,
    write_tables,
)


def row(psnr: float | None, ssim: float | None, lpips: float | None = None) -> dict:
    values = dict.fromkeys(METRICS, None) | {"psnr": psnr, "ssim": ssim, "lpips_vgg": lpips}
    return {region: dict(values) for region in REGIONS}


def metrics() -> dict:
    return {
        "capture": "c",
        "method": "my_method",
        "frames": {"train": 7, "test": 3},
        "protocols": {"standard": row(30.004, 0.9, 0.1)},
        "trivial": {"median_background": row(20, 0.95, 0.2), "nearest_frame": row(30.001, 0.8)},
        "blurry_input": row(40, 0.99, 0.01),
        "protocol_notes": {"standard": "how"},
        "novel_views": {"side": row(18, 0.5)},
        "weights": {"st_lpips": {"sha256": None, "reason": "fetch it"}},
    }


def test_best_is_by_what_is_printed_and_the_blurry_input_does_not_compete():
    (table,) = tables_of(metrics())

    def best(metric):
        column = table.headings.index(Heading.of("full", metric))
        return [row.title for row in table.rows if table.rank(row, column) == 1]

    # Two are printed as 30.00.
    assert best("psnr") == ["my_method", "nearest training frame (trivial)"]
    assert best("ssim") == ["median background (trivial)"]
    assert best("lpips_vgg") == ["my_method"]


def test_columns_without_any_figure_are_left_out():
    (table,) = tables_of(metrics())
    assert {heading.title for heading in table.headings} == {"PSNR", "SSIM", "LPIPS-VGG"}


def test_markdown_names_protocol_rows_novel_views_and_what_is_missing(tmp_path):
    write_tables(tmp_path, metrics())
    text = (tmp_path / "metrics.md").read_text()
    assert "## Protocol standard" in text and "blurry input itself" in text
    assert "| side | 18.00 | 0.5000 |" in text and "- fetch it" in text
    lines = [line for line in text.splitlines() if line.startswith("|")]
    assert len({line.count("|") for line in lines[:6]}) == 1
    assert "| **30.00** |" in text and "| – |" in text


def test_what_networks_lack_is_not_told_where_nothing_is_compared():
    told = metrics()
    assert missing_networks(told) == ["fetch it"]
    for row in (told["protocols"]["standard"], told["blurry_input"]):
        row["full"]["psnr"] = None
    assert missing_networks(told) == ["fetch it"]  # in novel views
    assert missing_networks(told | {"novel_views": {}}) == []


def test_latex_is_escaped_and_every_row_has_all_cells(tmp_path):
    write_tables(tmp_path, metrics())
    text = (tmp_path / "metrics.tex").read_text()
    assert r"my\_method" in text
    body = text[text.index(r"\midrule") : text.index(r"\bottomrule")].splitlines()[1:]
    assert len(body) == 4 and {line.count("&") for line in body} == {9}


@pytest.mark.parametrize(
    ("name", "written"),
    [
        ("<b>|a", r"\textless{}b\textgreater{}\textbar{}a"),
        ("[ours]", "{}[ours]"),
        ("*", "{}*"),
        ("ours*", "ours*"),
    ],
)
def test_a_row_of_any_name_is_itself_in_latex(name, written):
    rows = (Row("first", (Figure(1.0),)), Row(name, (Figure(2.0),)))
    text = latex([Table("t", "n", (Heading("full", "PSNR", 2, True),), rows)])
    assert f"{written} & " + r"\textbf{2.00} \\" in text.splitlines()


def test_a_row_without_any_figure_has_its_reason_below(tmp_path):
    told = metrics()
    told["trivial"]["median_background"] = row(None, None)
    assert "median background (trivial)" not in " ".join(tables_of(told)[0].footnotes)
    told["reasons"] = {
        "trivial.median_background.full.psnr": "c: the camera moves.",
        "trivial.nearest_frame.full.lpips_vgg": "no weights",
    }
    sentence = "median background (trivial): c: the camera moves."
    assert tables_of(told)[0].footnotes == (sentence,)
    write_tables(tmp_path, told)
    assert f"- {sentence}" in (tmp_path / "metrics.md").read_text().splitlines()
    assert f"% {sentence}" in (tmp_path / "metrics.tex").read_text().splitlines()
    told["protocols"]["avatar-compat"] = row(20, 0.9)
    told["protocol_notes"]["avatar-compat"] = "how"
    rows = {"on_median_background": row(None, None), "nearest_frame": row(None, None)}
    told["compat_rows"] = {"avatar-compat": rows}
    for name in rows:
        told["reasons"][f"compat_rows.avatar-compat.{name}.full.psnr"] = "it moves"
    both = "the same person on the median background, nearest training frame (trivial): it moves."
    assert tables_of(told)[1].footnotes == (both,)
