"""Where `evsplat inspect` draws when nobody says where: no capture's drawings replace another's."""

import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from evsplat.cli import main
from evsplat.inspection import default_folder
from evsplat.inspection.folder import note_inspected

Factory = Callable[..., Path]


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The working directory, which may be read by another path than its own."""
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")


def chosen(path: Path) -> Path:
    """The folder that an inspection takes, and gives back."""
    with default_folder(path) as folder:
        assert folder.is_dir()
    return folder


@pytest.mark.parametrize("name", ["dance", "a dance 100%", "tänzerin #2?"])
def test_two_captures_of_one_name_have_a_folder_each(
    tiny_capture: Factory, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    first, second = (
        tiny_capture(f"{folder}/{name}", frames=4, seed=seed)
        for seed, folder in enumerate(("one", "two"))
    )
    main(["inspect", str(first)])
    folder = Path("inspect") / name
    drawn = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert "contact_sheet.png" in drawn
    main(["inspect", str(second)])
    assert f"inspect/{name}-2: contact_sheet.png" in capsys.readouterr().out
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == drawn
    again = Path("inspect") / f"{name}-2"
    other = (again / "contact_sheet.png").read_bytes()
    assert other != drawn["contact_sheet.png"]
    link = Path("link")
    link.symlink_to(second.parent)
    assert chosen(first) == folder
    assert chosen(link / name) == chosen(second) == again


def test_a_link_to_a_capture_is_known_by_its_own_name(tiny_capture: Factory) -> None:
    path = tiny_capture("far/dance v2", frames=4)
    Path("dance").symlink_to(path)
    assert chosen(Path("dance")) == Path("inspect/dance")
    assert main(["masks", "dance"]) == 0
    assert Path("dance-masked/capture.json").is_file()
    assert [folder.name for folder in path.parent.iterdir()] == ["dance v2"]


def test_what_does_not_say_what_it_shows_stays(tiny_capture: Factory) -> None:
    path = tiny_capture("dance", frames=4)
    folders = [Path("inspect") / name for name in ("dance", "dance-2", "dance-3", "dance-4")]
    folders[0].mkdir(parents=True)
    assert chosen(path) == folders[0]  # nothing is in it
    (folders[0] / "mine.png").touch()
    folders[1].touch()
    folders[2].mkdir()
    (folders[2] / "inspected.json").write_text("[")
    assert chosen(path) == folders[3]
    assert not folders[3].exists()  # nothing was drawn


def test_a_killed_inspection_of_the_same_capture_leaves_its_folder_to_the_next_one(
    tiny_capture: Factory,
) -> None:
    path, folder = tiny_capture("dance", frames=4), Path("inspect/dance")
    folder.mkdir(parents=True)
    (folder / ".inspecting").write_text("1")
    assert chosen(path) == folder
    note_inspected(path, folder)
    (folder / "contact_sheet.png").write_bytes(b"half of them")
    assert main(["inspect", str(path)]) == 0
    assert [entry.name for entry in folder.parent.iterdir()] == ["dance"]
    assert not (folder / ".inspecting").exists()


@pytest.mark.parametrize(
    ("drawn", "other", "expected"),
    [
        (True, "two", "inspect/dance-2"),
        (True, "one", "inspect/dance"),
        (False, "two", "inspect/dance"),  # that one turned out to be no capture
    ],
)
def test_who_comes_while_another_is_drawn_waits_to_see_which(
    tmp_path: Path, drawn: bool, other: str, expected: str
) -> None:
    first, second = tmp_path / "one" / "dance", tmp_path / other / "dance"
    found: list[Path] = []
    waiting = threading.Thread(target=lambda: found.append(chosen(second)))
    with default_folder(first) as folder:
        waiting.start()
        time.sleep(0.2)
        assert not found
        if drawn:
            note_inspected(first, folder)
    waiting.join(60)
    assert found == [Path(expected)]
