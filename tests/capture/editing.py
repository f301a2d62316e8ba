"""Changes of a capture's description."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any


def edit(path: Path, change: Callable[[dict[str, Any]], object]) -> Path:
    """Change capture.json of a folder, which comes back."""
    document = json.loads((path / "capture.json").read_text())
    change(document)
    (path / "capture.json").write_text(json.dumps(document))
    return path
