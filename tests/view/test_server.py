"""Where the viewer listens, and that it follows its runs."""

import socket
import threading
from urllib.parse import urlsplit

import pytest

pytest.importorskip("viser", reason="needs the extra view: pip install 'evsplat[view]'")

from evsplat.capture import load_capture  # noqa: E402
from evsplat.errors import ConfigError  # noqa: E402
from evsplat.training.reconstruction import GaussianReconstruction  # noqa: E402
from evsplat.training.run import Run  # noqa: E402
from evsplat.view import viewed_run  # noqa: E402
from evsplat.view.server import Viewer, _address, _free_port  # noqa: E402

from ..small_model import built, small_config  # noqa: E402


def test_a_port_in_use_gives_way_to_a_later_one():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        found = _free_port("127.0.0.1", port)
        assert port < found <= port + 20
    assert _free_port("127.0.0.1", port) == port


@pytest.mark.parametrize(
    ("host", "port", "named"),
    [("127.0.0.1", 0, "--port 0"), ("no.such.host.invalid", 8080, "no.such.host.invalid")],
)
def test_an_address_that_cannot_be_had_is_named(host, port, named):
    with pytest.raises(ConfigError, match=named):
        _free_port(host, port)


@pytest.mark.parametrize(
    ("host", "named"),
    [("127.0.0.1", "127.0.0.1"), ("0.0.0.0", "localhost"), ("::", "localhost"), ("::1", "[::1]")],
)
def test_the_address_is_one_that_a_browser_can_open(host, named):
    assert _address(host, 8080) == f"http://{named}:8080"
    assert urlsplit(_address(host, 8080)).port == 8080


def test_a_run_that_is_trained_on_later_is_followed(tiny_capture, tmp_path, monkeypatch):
    """Its training had ended when the viewer began."""
    capture, config = load_capture(tiny_capture()), small_config("evsplat")
    made = GaussianReconstruction("evsplat", built("evsplat", capture).model)
    facts = (capture, made, 0, 0.0, "cpu", {"human": 1, "scene": 1}, False)
    run = Run(tmp_path / "run", config, "evsplat", config.policy, *facts)
    states = tmp_path / "run" / "checkpoints"
    states.mkdir(parents=True)
    (states / "000010.safetensors").touch()
    taken, reloaded = [], threading.Event()

    def reload(_: viewed_run.ViewedRun, state) -> None:
        taken.append(state)
        reloaded.set()

    monkeypatch.setattr(viewed_run.ViewedRun, "reload", reload)
    monkeypatch.setattr(viewed_run, "_POLL_S", 0.02)
    viewer = Viewer([run], host="127.0.0.1", port=_free_port("127.0.0.1", 28_080))
    try:
        assert not reloaded.wait(0.5)
        (states / "000020.safetensors").touch()
        assert reloaded.wait(20)
    finally:
        viewer.close()
    assert taken == [states / "000020.safetensors"]
