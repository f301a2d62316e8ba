"""The garbage collector around imports."""

import gc
import subprocess
import sys

import pytest

from evsplat.cli.importing import kept_objects


@pytest.mark.parametrize("collects", [True, False])
def test_the_collector_is_afterwards_as_it_was_even_where_an_import_fails(collects):
    before = gc.isenabled()
    try:
        (gc.enable if collects else gc.disable)()
        with pytest.raises(ImportError), kept_objects():
            assert not gc.isenabled()
            raise ImportError
        assert gc.isenabled() == collects
    finally:
        (gc.enable if before else gc.disable)()


def test_only_a_process_that_has_just_begun_keeps_its_objects_for_good():
    """Later there may be garbage, which would stay as well."""
    code = (
        "import gc, sys; from evsplat.cli.importing import kept_objects\n"
        "for module in ('torch', 'scipy.ndimage'):\n"
        "    with kept_objects(): __import__(module)\n"
        "    print(gc.get_freeze_count())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    first, second = map(int, done.stdout.split())
    assert first > 50_000 and second <= first
