"""Tools end quietly, as the system's own do, where nobody reads on what they print."""

from __future__ import annotations

import os
import subprocess
import sys

from redetect.command_line import EXIT_UNREAD


def test_nobody_reads_on_what_a_tool_prints() -> None:
    reading, writing = os.pipe()
    os.close(reading)
    try:
        process = subprocess.run(
            [sys.executable, "-m", "tools.evaluation", "accuracy"],
            stdout=writing,
            stderr=subprocess.PIPE,
            env={**os.environ, "PYTHONUNBUFFERED": "1"},
            check=False,
        )
    finally:
        os.close(writing)
    assert process.stderr == b""
    assert process.returncode == EXIT_UNREAD
