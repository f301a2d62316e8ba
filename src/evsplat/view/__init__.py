"""The web viewer: a trained run in the browser, at any time and from anywhere."""

from pathlib import Path

from evsplat.errors import ConfigError


def view_run(
    run: Path | str,
    other: Path | str | None = None,
    *,
    port: int = 8080,
    host: str = "127.0.0.1",
    device: str = "auto",
    threads: int | None = None,
) -> None:
    """Show a run in the browser until Ctrl-C, or two runs of one capture to compare.

    Only this machine can reach it unless ``host`` says otherwise. A ``port`` in use gives way to
    the next free one, which is said with the address. ``threads`` is the number of CPU threads that
    draw; None takes all cores.

    Raises:
        ConfigError: the package viser is missing, or the address cannot be listened at.
        DataError: no run folder, no checkpoint in it, or runs of two captures.
    """
    check_viewer()
    from evsplat.devices import use_threads
    from evsplat.view.server import serve

    use_threads(threads)

    serve([path for path in (run, other) if path is not None], host, port, device)


def check_viewer() -> None:
    """Raise a `ConfigError` that says how to get the viewer where it is not installed."""
    try:
        import viser  # noqa: F401
    except ImportError:
        raise ConfigError(
            "The viewer needs the package viser; get it with: pip install 'evsplat[view]'."
        ) from None


__all__ = ["check_viewer", "view_run"]
