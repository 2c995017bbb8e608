"""The program ``detect``, also as ``python -m detect``.

Worker processes import this module, too, so the command line is imported when it runs.
"""

import sys

from redetect.interrupts import start


def main() -> int:
    """Run the command line; returns the exit code."""
    return start("detect.cli")


if __name__ == "__main__":
    sys.exit(main())
