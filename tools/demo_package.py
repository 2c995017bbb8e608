"""The first frames of the demo run, copied into the package for `redetect demo`.

    python -m tools.demo_package

Run it after `images/e` has changed; a test holds both against each other.
"""

from __future__ import annotations

import shutil
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
DEMO, PACKAGE = ROOT / "images" / "e", ROOT / "redetect" / "demo"
FRAMES = 24
_ROWS = (
    "e.txt",
    "map.circles",
    "map.lines",
    "unlisted.circles",
    "unlisted.lines",
    "lookalikes.circles",
)


def first_frames(text: str, frames: int = FRAMES) -> str:
    """The head of a file of rows, and the rows of its first frames."""
    parts = text.split("\nSTEP ")
    return "\nSTEP ".join(parts[: frames + 1]).rstrip("\n") + "\n"


def main() -> None:
    """Copy images, calibration and rows."""
    (PACKAGE / "images").mkdir(parents=True, exist_ok=True)
    for name in _ROWS:
        place = "demo.txt" if name == "e.txt" else name
        (PACKAGE / place).write_text(first_frames((DEMO / name).read_text()))
    shutil.copy(DEMO / "e.cam", PACKAGE / "demo.cam")
    for image in sorted((DEMO / "images").iterdir())[:FRAMES]:
        shutil.copy(image, PACKAGE / "images")


if __name__ == "__main__":
    main()
