"""``python -m redetect.slam`` is the command."""

from __future__ import annotations

import sys
from runpy import run_module

import pytest


def test_the_room_is_started_as_a_module(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["slam", "--help"])
    with pytest.raises(SystemExit) as ended:
        run_module("redetect.slam", run_name="__main__")
    assert ended.value.code == 0
    assert "usage: slam" in capsys.readouterr().out
