"""``evsplat doctor``: what is installed, what is missing and where to get it."""


def doctor(*, json: bool = False) -> None:
    """Say what is installed, what is missing and where to get it.

    Args:
        json: Print one JSON object instead of lines.
    """
    raise NotImplementedError
