"""The extension module; its docstrings, which native/*module.cpp write, say what it takes."""

from typing import Any

def __getattr__(name: str) -> Any: ...
