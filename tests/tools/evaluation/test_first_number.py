"""The table of first numbers: its place in a document, and the bag that is recorded for it."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from detect.sources.opening import open_source
from tools.evaluation.first_number import BEGIN, END, FirstNumber, put_into, table_of, write_bag


def test_the_table_takes_its_place(tmp_path: Path) -> None:
    document = tmp_path / "figures.md"
    document.write_text(f"before\n{BEGIN}\nold\n{END}\nafter\n")
    table = table_of([FirstNumber("demo", "`detect all`", 310, 314, 0.0017, 0.8372)])

    put_into(document, table)

    assert "| demo | `detect all` | 310 of 314 | 1.7 | 0.84 |" in document.read_text()
    assert document.read_text().startswith(f"before\n{BEGIN}")
    assert document.read_text().endswith(f"{END}\nafter\n")
    assert "old" not in document.read_text()
    (tmp_path / "other.md").write_text("nothing")
    with pytest.raises(ValueError, match="lacks"):
        put_into(tmp_path / "other.md", table)


def test_the_bag_holds_the_images(project_root: Path, tmp_path: Path) -> None:
    images = tmp_path / "images"
    images.mkdir()
    for name in ("e.0000.jpg", "e.0001.jpg"):
        shutil.copy(project_root / "images" / "e" / "images" / name, images)
    shutil.copy(project_root / "images" / "e" / "e.cam", tmp_path)

    run = open_source(write_bag(images, tmp_path / "drive"))

    assert len(list(run.frames)) == 2
