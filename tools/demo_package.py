"""The first frames of the demo run, copied into the package for `redetect demo`.

    python -m tools.demo_package

Run it after `images/e` has changed; a test compares the two.
"""

from __future__ import annotations

import shutil
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
DEMO, PACKAGE = ROOT / "images" / "e", ROOT / "redetect" / "demo"
FRAMES = 24


def first_frames(text: str) -> str:
    """The head of a file of rows, and the rows of its first frames."""
    parts = text.split("\nSTEP ")
    return "\nSTEP ".join(parts[: FRAMES + 1]).rstrip("\n") + "\n"


def main() -> None:
    """Copy images, calibration and rows."""
    (PACKAGE / "images").mkdir(parents=True, exist_ok=True)
    for rows in (DEMO / "e.txt", *DEMO.glob("*.circles"), *DEMO.glob("*.lines")):
        place = "demo.txt" if rows.name == "e.txt" else rows.name
        (PACKAGE / place).write_text(first_frames(rows.read_text()))
    shutil.copy(DEMO / "e.cam", PACKAGE / "demo.cam")
    for image in sorted((DEMO / "images").iterdir())[:FRAMES]:
        shutil.copy(image, PACKAGE / "images")


if __name__ == "__main__":
    main()
