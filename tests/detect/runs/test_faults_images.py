"""Image files that are no images, or claim to be enormous: refused, with little memory taken."""

from __future__ import annotations

import gc
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from camera import Camera
from detect.errors import FrameError
from detect.sources.grey_images import bounded_content, decode_grey, read_image
from detect.sources.interface import RunFrame
from redetect.landmarks import Step
from redetect.storage.images import MOST_PIXELS, claimed_size
from tests.detect.commands import output_of
from tests.detect.runs.claimed_images import SIDE, TEXTURE, bmp, jpeg, png, pnm, tiff


def frame_of(path: Path) -> RunFrame:
    return RunFrame(Step(path.stem, *[0.0] * 9), path)


@pytest.mark.parametrize("suffix", ["jpg", "png", "bmp", "pgm", "ppm", "tif"])
@pytest.mark.parametrize("colour", [False, True])
def test_sizes_are_those_of_the_decoder(suffix: str, colour: bool) -> None:
    coloured = suffix != "pgm" and (colour or suffix == "ppm")
    image = np.dstack([TEXTURE] * 3) if coloured else TEXTURE
    done, content = cv2.imencode(f".{suffix}", image)
    assert done
    assert claimed_size(content.tobytes()) == (96, 48)


@pytest.mark.parametrize("make", [jpeg, png, pnm, bmp, tiff])
def test_sizes_that_are_only_claimed(make: Callable[[int, int], bytes]) -> None:
    assert claimed_size(make(SIDE, SIDE - 1)) == (SIDE, SIDE - 1)


def test_other_tiffs() -> None:
    assert claimed_size(tiff(700, 300, ">")) == (700, 300)
    assert claimed_size(tiff(700, 300, "<", big=True)) == (700, 300)
    assert claimed_size(tiff(700, 300, ">", tile=1 << 20)) == (1 << 20, 1 << 20)
    # Padded tiles of a small image: what a decoder takes for one is no fault.
    assert claimed_size(tiff(180, 100, "<", tile=512)) == (180, 100)
    progressive = cv2.imencode(".jpg", TEXTURE, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    assert claimed_size(progressive) == (96, 48)


@pytest.mark.parametrize("make", [jpeg, png, pnm, bmp, tiff])
def test_headers_that_end_too_early_claim_nothing(make: Callable[[int, int], bytes]) -> None:
    content = make(768, 288)
    sizes = {claimed_size(content[:length]) for length in range(len(content))}
    assert sizes <= {None, (768, 288), (768, 0)}
    assert None in sizes


@pytest.mark.parametrize("make", [jpeg, png, pnm, bmp, tiff])
def test_enormous_images_are_refused_by_their_header(
    tmp_path: Path, published_camera: Camera, make: Callable[[int, int], bytes]
) -> None:
    path = tmp_path / "a.jpg"
    path.write_bytes(make(SIDE, SIDE))
    claim = f"cannot be decoded: claims 60000x60000 px: expected at most {MOST_PIXELS}"
    for camera in (published_camera, None):
        with pytest.raises(FrameError, match=claim):
            read_image(frame_of(path), camera)
    path.write_bytes(make(SIDE, 288))
    with pytest.raises(FrameError, match="is 60000x288 px: expected 768x288"):
        read_image(frame_of(path), published_camera)


_PEAK = """
import re, sys
from pathlib import Path
from detect.errors import FrameError
from detect.sources.interface import RunFrame
from detect.sources.grey_images import read_image
from redetect.landmarks import Step
import cv2

def peak_kib():
    # Not what `getrusage` has: that begins with the peak of the process that started this one.
    (peak,) = re.findall(r"VmHWM:\\s*(\\d+) kB", Path("/proc/self/status").read_text())
    return int(peak)

before = peak_kib()
for path in sys.argv[1:]:
    for _ in range(3):
        try:
            read_image(RunFrame(Step("a", *[0.0] * 9), Path(path)), None)
        except FrameError:
            pass
        else:
            raise SystemExit(1)
print(peak_kib() - before)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="counts memory in Linux's units")
def test_enormous_images_take_no_memory(tmp_path: Path) -> None:
    """Also those of 30,000 x 30,000 pixels, which the decoder itself would begin to decode."""
    paths = []
    for side in (SIDE, 30_000):
        for make in (jpeg, png, pnm, bmp, tiff):
            paths.append(tmp_path / f"{make.__name__}.{side}.png")
            paths[-1].write_bytes(make(side, side))
    grown_kib = int(output_of(_PEAK, *map(str, paths)))
    assert grown_kib < 8 * 1024  # the images claim 0.9 and 3.6 million times that


def test_files_larger_than_any_such_image_are_not_read(
    tmp_path: Path, published_camera: Camera
) -> None:
    path = tmp_path / "a.png"
    with path.open("wb") as stream:
        stream.truncate(1 << 40)  # a file of nothing takes no room
    with pytest.raises(FrameError, match="cannot be read: larger than"):
        read_image(frame_of(path), published_camera)


def test_a_folder_leaves_no_descriptor_behind(tmp_path: Path) -> None:
    if not Path("/dev/fd").is_dir():
        pytest.skip("counts descriptors in /dev/fd")
    (tmp_path / "a.png").mkdir()
    gc.collect()  # what other tests left open is not closed meanwhile
    before = len(list(Path("/dev/fd").iterdir()))
    for _ in range(20):
        with pytest.raises(FrameError, match="Is a directory"):
            bounded_content(tmp_path / "a.png", "a", (768, 288))
    assert len(list(Path("/dev/fd").iterdir())) == before


def test_an_image_with_its_sides_exchanged_is_refused_by_its_header() -> None:
    # None is turned, whatever it says of how its camera was held.
    sides = cv2.imencode(".png", np.resize(TEXTURE, (288, 768)))[1].tobytes()
    assert decode_grey(sides, "a", (768, 288)).shape == (288, 768)
    for size in ((288, 768), (288, 767)):
        with pytest.raises(FrameError, match=f"is 288x{size[1]} px: expected 768x288"):
            decode_grey(png(*size), "a", (768, 288))


@pytest.mark.parametrize("content", [b"RIFF0000WEBPVP8 ", b"GIF89a", b"\0\0\0\x0cjP  ", b"P6 junk"])
def test_other_kinds_are_no_images_of_a_run(content: bytes) -> None:
    with pytest.raises(FrameError, match="cannot be decoded: expected an image"):
        decode_grey(content + bytes(100), "a", None)
