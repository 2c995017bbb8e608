"""Every reader on files that are damaged, or put together from the words of its language.

A short, seeded run of what `python -m tools.fuzz` does for as long as one likes: a result, or a
typed error whose message names the file and fits on one printable line of bounded length.
"""

from __future__ import annotations

import random
import re
from collections.abc import Sequence
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, seed, settings
from hypothesis import strategies as st

from tools.fuzz.reader import Reader, attempt
from tools.fuzz.readers import READERS

#: Memory that a reader may take for a file of some kilobytes.
_MOST_BYTES = 64 << 20
_CLEAR = Path("/proc/self/clear_refs")

each_reader = pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.name)


@pytest.fixture
def folder(reader: Reader, tmp_path: Path) -> Path:
    """The folder of a reader's file, with what else it needs."""
    reader.prepare(tmp_path)
    return tmp_path


@each_reader
def test_what_fuzzing_begins_with_is_accepted(reader: Reader, folder: Path) -> None:
    for content in reader.all_seeds():
        path = folder / reader.file
        path.write_bytes(reader.content(content))
        assert attempt(reader, path) is None


def damaged(content: bytes, words: Sequence[bytes], chance: random.Random) -> bytes:
    """Change a file in one to four places: bits, pieces left out, doubled or moved, words."""
    for _ in range(chance.randint(1, 4)):
        at = chance.randint(0, len(content))
        end = min(len(content), at + chance.choice((1, 1, 2, 8, 40)))
        kind = chance.randrange(6)
        if kind == 0:
            content = content[:at] + content[end:]
        elif kind == 1:
            content = content[:end] + content[at:]
        elif kind == 2:
            noise = bytes(chance.randrange(256) for _ in range(chance.randint(1, 4)))
            content = content[:at] + noise + content[at:]
        elif kind == 3 and words:
            content = content[:at] + chance.choice(words) + content[end:]
        elif kind == 4 and at < len(content):
            flipped = content[at] ^ (1 << chance.randrange(8))
            content = content[:at] + bytes([flipped]) + content[at + 1 :]
        else:
            to = chance.randint(0, len(content))
            content = content[:to] + content[at:end] + content[to:]
    return content


@each_reader
def test_damaged_files(reader: Reader, folder: Path) -> None:
    path = folder / reader.file
    chance = random.Random(f"damage of {reader.name}")
    seeds = reader.all_seeds()
    path.write_bytes(reader.content(seeds[0]))
    attempt(reader, path)  # what is imported and compiled is no memory for a file
    before = _memory("VmRSS")
    if _CLEAR.exists():
        _CLEAR.write_text("5")  # the peak is counted from here
    for _ in range(reader.files):
        content = damaged(chance.choice(seeds), reader.words, chance)
        path.write_bytes(reader.content(content))
        attempt(reader, path)
    assert _memory("VmHWM") - before < _MOST_BYTES


def _memory(name: str) -> int:
    """Memory that is in use or was at most, as Linux counts it; 0 elsewhere."""
    if not _CLEAR.exists():
        return 0
    (kib,) = re.findall(rf"{name}:\s*(\d+) kB", Path("/proc/self/status").read_text())
    return int(kib) << 10


@each_reader
def test_files_of_a_reader_s_own_words(reader: Reader, folder: Path) -> None:
    words = st.sampled_from(
        [*reader.words, *(word for content in reader.all_seeds() for word in content.split(b" "))]
    )
    glue = st.sampled_from(
        [b"", b" ", b"\n", b"\r\n", b",", b"\t", b"\0", b"\xff", b"\xe2\x80\xa8"]
    )

    @seed(2)
    @settings(
        max_examples=1 + reader.files // 3,
        deadline=None,
        database=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(st.lists(st.tuples(words, glue), max_size=40))
    def read(pieces: list[tuple[bytes, bytes]]) -> None:
        path = folder / reader.file
        content = b"".join(word + between for word, between in pieces)
        path.write_bytes(reader.content(content))
        attempt(reader, path)

    read()


@each_reader
def test_what_is_no_file(reader: Reader, folder: Path) -> None:
    """A folder in its place; nothing at all."""
    if not reader.errors or not reader.needed:
        pytest.skip("reads bytes, not files, or the file may be absent")
    path = folder / reader.file
    assert attempt(reader, path) is not None
    path.mkdir()
    assert attempt(reader, path) is not None


NASTY = [
    ("map", b"kind,id,x_m,y_m,cxx_m2,cxy_m2,cyy_m2,rows\ndisc,3,1,2,1,1e20,1,5\n", "negative"),
    ("g2o", b"\x1f\x1f\n", "VERTEX_SE2"),
    ("scans", b"1 1e308 1e308 1e308\n", None),
    ("ptpd", b"a, my offset from master, c\n1, 2, 3\n", "no line"),
    ("ptpd", b"offset from master, a, timestamp\n1,2\n", None),
    ("rig", b'{"dictionary": "x", "markers": {"3": {"width_m": 1' + b"0" * 400 + b"}}}", "width_m"),
    ("rig", b'{"dictionary": 1' + b"0" * 5000 + b"}", "too long"),
    ("rig", b"[" * 100_000, "nested too deep"),
    ("boards", b'{"boards": {"world": {"columns": 3, "rows": 4, "square_m": 1}}, "images":'
     b' [{"camera": "a", "board": []}], "world_from_board": {"translation_m": [0, 0, 0],'
     b' "quaternion_xyzw": [0, 0, 0, 1]}}', "board is"),
    ("network", b'{"cameras": {"\x7f\\u001b[2J": 1}}', "expected an object"),
    ("network", b'{"cameras": {"a": {"calibration": "../../../etc/passwd"}}}', "a .cam file by"),
    ("network", b'{"cameras": {"a": {"calibration": "/etc/passwd"}}}', "a .cam file by"),
    ("network", b'{"cameras": {"a": {"calibration": "a\\u0000.cam"}}}', "a .cam file by"),
    ("tilts", b"TILT " + b"x" * 70_000, "longer than 65536 bytes"),
    ("image header", b"II+\0\x08\0\0\0" + b"\xff" * 8, None),
    ("scan arrays", b"PK\x05\x06" + bytes(18), "no such array"),
    ("colmap", b"".join(b"%d PINHOLE 4 4 1 1 1 1\n" % k for k in range(999)), "it holds 0, 1, 2"),
    ("colmap", b"1 PINHOLE " + b"9" * 4000 + b" 4 1 1 1 1\n", "width is"),
    ("opencv", b"image_width: 0x" + b"f" * 9000 + b"\n", "image_height"),
    ("opencv", b"image_width: 4\nimage_height: 4\ncamera_matrix: [0x" + b"f" * 9000 + b"]\n",
     "camera_matrix has a very long number"),
    ("opencv", b"image_width: 4\nimage_height: 4\nK: [1" + b"0" * 400 + b"]\n", "matrix has"),
    ("opencv", b"image_width: 4\nimage_height: 4\nK: [" + b"1, " * 900 + b"1]\n", "expected the 9"),
    ("opencv", b"? 0x" + b"f" * 9000 + b"\n: 1\n", "lacks image_width"),
    ("opencv", b"a: &a [1]\nb: *a\n", "an alias"),
    ("opencv", b"[" * 5000, "invalid YAML"),
    ("camera info", b"!!python/object/apply:os.system ['true']\n", "expected YAML"),
    ("kalibr", b"a: {intrinsics: 1}\n" + b"b" * 900 + b": {intrinsics: 1}\n", "it holds a, bbb"),
    ("floor points", b"u,v,x,y\n\"" + b"1" * 200_000, "expected 4 numbers: u v x y"),
    ("floor points", b"\xff\n", "floor points: it is not text"),
    ("settings", b"# settings threshold=1-2\n", "expected a number"),
    ("settings", b"# settings polarity=" + b"x" * 60_000, "expected one of"),
    # The time of a message in SQLite's own column is bytes.
    ("sqlite cells", b"\x07\x28\0\5bytes", "message 1 of /cam/image_raw cannot be read"),
    # The images' type is of 255 characters that must not reach a terminal.
    ("sqlite cells", b"\x04\x07\0\xff" + b"\x1b" * 255, "no images in it, but \\x1b"),
    ("trajectory", b"0 0 0 0 0 0 0 1\n1 1e300 0 0 0 0 0 1\n", "at most 1e+12 m"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "content", "message"), NASTY)
def test_what_fuzzing_found_or_might(
    name: str, content: bytes, message: str | None, tmp_path: Path
) -> None:
    (reader,) = [reader for reader in READERS if reader.name == name]
    path = tmp_path / reader.file
    path.write_bytes(reader.content(content))
    error = attempt(reader, path)
    assert (error is None) == (message is None)
    assert message is None or message in str(error)
