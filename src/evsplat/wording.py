"""Words in sentences for the user."""


def counted(number: float, noun: str) -> str:
    """A number with its noun, such as "1 frame" and "2.5 frames"."""
    return f"{number:.15g} {noun}" + ("s" if number != 1 else "")


def begun(words: str) -> str:
    """Words, at least a letter of them, as a sentence begins."""
    return words[0].upper() + words[1:]


def in_a_line(error: object) -> str:
    """An error, with its kind, or another object in a line of at most 120 characters."""
    text = f"{type(error).__name__}: {error}" if isinstance(error, BaseException) else str(error)
    return " ".join(text.split())[:120]
