"""Words in sentences for the user."""


def counted(number: float, noun: str) -> str:
    """A number with its noun, such as "1 frame" and "2.5 frames"."""
    return f"{number:g} {noun}" if number == 1 else f"{number:g} {noun}s"
