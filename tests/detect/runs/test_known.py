"""Files looked into image by image: what reading them whole says."""

from __future__ import annotations

from pathlib import Path

import pytest

from detect.runs.plan import FramesByImage, Priors
from redetect.landmarks import LandmarkFileError, read_frames

LINES = """\
# IDs by hand
STEP k.0001  0.1 0 0 1 0 1 0 0 1
LANDMARK_L 0 -0.6 0 0.3 0.25 0 0 0.003 7

STEP images/k.0000.jpg  0.1 0 0 1 0 1 0 0 1
STEP k.0002  0.1 0 0 1 0 1 0 0 1
LANDMARK_L 0 -0.6 0 0.3 \\
  0.5 0 0 0.003 8 9
LANDMARK_L 0 -0.6 0 0.3 0.75 0 0 0.003 -1
STEP k.0003  0.1 0 0 1 0 1 0 0 1
LANDMARK_L 0 -0.6 0 0.3 1.25 0 0 0.003 3
STEP k.0003  0.1 0 0 1 0 1 0 0 1
LANDMARK_L 0 -0.6 0 0.3 1.5 0 0 0.003 4
"""


@pytest.mark.parametrize("line_end", ["\n", "\r\n"])
@pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"])
def test_lines_are_those_of_the_frame(tmp_path: Path, line_end: str, mark: bytes) -> None:
    path = tmp_path / "k.lines"
    path.write_bytes(mark + LINES.replace("\n", line_end).encode())
    found = Priors(lines=FramesByImage(path))
    for frame in list(read_frames(path))[:3]:
        assert found.of(frame.step.prefix).lines == frame.lines
    (line,) = found.of("k.0001.png").lines
    assert (line.alpha, line.ids) == (0.25, (7,))
    assert [line.ids for line in found.of("k.0002").lines] == [(8, 9), (-1,)]
    assert found.of("k.0000").lines == ()
    (last,) = found.of("k.0003").lines
    assert last.ids == (4,)
    assert found.of("k.0004").lines == ()


def test_malformed_files_are_named(tmp_path: Path) -> None:
    path = tmp_path / "k"
    path.write_text(LINES + "LANDMARK_L 0 0\n")
    with pytest.raises(LandmarkFileError, match="k:14: "):
        FramesByImage(path)
    with pytest.raises(LandmarkFileError, match="no such"):
        FramesByImage(tmp_path / "none")
