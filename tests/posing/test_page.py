"""The page of found poses in a narrow window."""

import re
import shutil
import subprocess

import pytest

from evsplat.pages import document
from evsplat.posing.page import _table

BROWSER = next(filter(None, map(shutil.which, ("chromium", "google-chrome", "chrome"))), None)


@pytest.mark.skipif(BROWSER is None, reason="needs Chromium to show the page")
def test_a_wide_table_scrolls_and_does_not_widen_the_page(tmp_path):
    rows = [("from", "landmarks of " + 12 * "a long name "), ("pictures", "14")]
    tables = _table(rows) + _table(rows, head=("", "mean"))
    script = (
        "<script>document.title = `beyond ${document.documentElement.scrollWidth - innerWidth}, "
        "tables ${document.querySelectorAll('table').length}`</script>"
    )
    page = tmp_path / "page.html"
    page.write_text(document("a", tables + script, style="poses.css"), encoding="utf-8")
    command = [BROWSER, "--headless", "--no-sandbox", "--window-size=500,800", "--dump-dom"]
    command += [f"--user-data-dir={tmp_path / 'profile'}", page.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=True)
    (beyond, count) = re.findall(r"beyond (-?\d+), tables (\d+)", done.stdout)[0]
    assert count == "2" and int(beyond) <= 0
