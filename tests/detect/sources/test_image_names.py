"""Names of images looked up, and their order."""

from __future__ import annotations

import re
import tempfile
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from detect.errors import FrameError
from detect.sources.image_files import ImageNames


def by_value(name: str) -> tuple[list[tuple[int, str]], str]:
    parts = re.findall(r"[0-9]+|[^0-9]+", name)
    return [(int(p), "") if p.isdecimal() else (-1, p) for p in parts], name


#: A superscript is a digit by some definitions, and no number.
FILE_NAMES = st.from_regex(r"[ab0-9][ab0-9\u00b2]{0,5}\.(jpg|PNG)", fullmatch=True)


@given(names=st.sets(FILE_NAMES, min_size=1, max_size=12))
def test_images_are_in_natural_order(names: set[str]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        for name in names:
            (Path(folder) / name).touch()
        (Path(folder) / "notes.txt").touch()
        images = ImageNames(Path(folder))
        assert images.names == sorted(names, key=by_value)
        for name in names:
            assert images.image_of(name) == Path(folder) / name
            first = next(n for n in images.names if Path(n).stem == Path(name).stem)
            assert images.image_of(Path(name).stem) == Path(folder) / first
        assert images.image_of("c") is None
        assert images.image_of("notes") is None


def test_hidden_files_are_no_images(tmp_path: Path) -> None:
    for name in ("a.jpg", "._a.jpg", ".b.jpg"):
        (tmp_path / name).touch()
    for pattern, found in (("*", "a.jpg"), ("*.jpg", "a.jpg"), (".b.jpg", ".b.jpg")):
        assert ImageNames(tmp_path, pattern).names == [found]


def test_a_prefix_may_go_up_within_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "run" / "images").mkdir(parents=True)
    (tmp_path / "run" / "images" / "a.png").touch()
    (tmp_path / "other").mkdir()
    monkeypatch.chdir(tmp_path / "other")
    images = ImageNames(Path("../run/images"))
    assert images.image_of("../images/a") == images.image_of('"a.png"') is not None
    with pytest.raises(FrameError, match="the prefix leads out of the folder: expected an image"):
        images.image_of("../../other/a")
