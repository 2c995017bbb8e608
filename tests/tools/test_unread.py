"""Tools end quietly, as the system's own do, where nobody reads on what they print."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from redetect.storage.command_line import EXIT_UNREAD


@pytest.mark.parametrize("command", ["evaluation accuracy", "evaluation fusion-speed --hours 0.01"])
def test_nobody_reads_on_what_a_tool_prints(command: str) -> None:
    module, *arguments = command.split()
    reading, writing = os.pipe()
    os.close(reading)
    try:
        process = subprocess.run(
            [sys.executable, "-m", f"tools.{module}", *arguments],
            stdout=writing,
            stderr=subprocess.PIPE,
            env={**os.environ, "PYTHONUNBUFFERED": "1"},
            check=False,
        )
    finally:
        os.close(writing)
    assert process.stderr == b""
    assert process.returncode == EXIT_UNREAD
