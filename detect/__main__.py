"""The program ``detect``, also as ``python -m detect``.

Worker processes import this module, too, so what only the command line needs is imported where it
is used.
"""

import sys


def main() -> int:
    """Run the command line; returns the exit code."""
    try:
        from detect.cli import main as command_line
    except KeyboardInterrupt:
        from redetect.command_line import say_interrupted

        return say_interrupted()
    return command_line()


if __name__ == "__main__":
    sys.exit(main())
