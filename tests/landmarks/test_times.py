"""Files of times: read by prefix, malformed ones are refused by line."""

from __future__ import annotations

from pathlib import Path

import pytest

from redetect.landmarks import LandmarkFileError
from redetect.landmarks.frame_files import format_time, read_times


def test_times_are_read_by_prefix(tmp_path: Path) -> None:
    path = tmp_path / "a.times"
    path.write_text("# prefix seconds\na0001 1235.250000\na0002 1235.300000 # late\n")
    assert read_times(path) == {"a0001": 1235.25, "a0002": 1235.3}
    path.write_text("a,1\nb, 2\n,,\nc ,3\n")
    assert read_times(path) == {"a": 1.0, "b": 2.0, "c": 3.0}
    path.write_text("a 1\na 2\n")
    with pytest.raises(LandmarkFileError, match="a second time"):
        read_times(path)


@pytest.mark.parametrize("prefix", ["a#1", "a\u00a0b", "a,b"])
def test_any_prefix_of_a_step_may_have_a_time(tmp_path: Path, prefix: str) -> None:
    path = tmp_path / "a.times"
    path.write_text(f"{format_time(prefix, 1.5)}\n")
    assert read_times(path) == {prefix: 1.5}


@pytest.mark.parametrize("content", ["s.0000\n", "s.0000 1 2\n", "s.0000 inf\n", "s.0000 x\n"])
def test_malformed_times(tmp_path: Path, content: str) -> None:
    (tmp_path / "a.times").write_text("# head\n" + content)
    with pytest.raises(LandmarkFileError, match=r"a\.times:2: .*an image's prefix and seconds"):
        read_times(tmp_path / "a.times")
