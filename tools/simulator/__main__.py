"""``python -m tools.simulator``."""

import sys

from tools.simulator.cli import main

if __name__ == "__main__":
    sys.exit(main())
