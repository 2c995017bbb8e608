"""Entry point of ``python -m tools.benchmark``."""

import sys

from tools.benchmark.cli import main

if __name__ == "__main__":
    sys.exit(main())
