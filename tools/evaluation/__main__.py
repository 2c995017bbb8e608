"""Entry point of ``python -m tools.evaluation``."""

import sys

from tools.evaluation.cli import main

if __name__ == "__main__":
    sys.exit(main())
