"""Words in sentences for the user."""


def counted(number: float, noun: str) -> str:
    """A number with its noun, such as "1 frame" and "2.5 frames"."""
    return f"{number:.15g} {noun}" + ("s" if number != 1 else "")
