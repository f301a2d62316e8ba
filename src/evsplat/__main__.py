"""``python -m evsplat`` is the command ``evsplat``."""

import sys

from evsplat.cli import main

if __name__ == "__main__":
    sys.exit(main())
