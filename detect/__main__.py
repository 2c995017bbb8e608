"""``python -m detect``: the command ``detect``."""

import sys

from detect.cli import main

if __name__ == "__main__":  # worker processes import this module too
    sys.exit(main())
