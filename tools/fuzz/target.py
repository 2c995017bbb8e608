"""One reader under atheris: `python -m tools.fuzz.target NAME [libFuzzer's flags]`.

atheris is no dependency of the project: `pip install atheris`.
"""

from __future__ import annotations

import os
import sys
import tempfile
import warnings
from pathlib import Path

import atheris  # type: ignore[import-untyped,import-not-found,unused-ignore]

with atheris.instrument_imports(
    include=[
        "camera",
        "detect.image_header",
        "detect.sources",
        "landmarks",
        "groundtruth",
        "slam",
        "lut",
        "tools.fuzz",
        "csv",
    ],
    enable_loader_override=False,
):
    from tools.fuzz.readers import READERS, attempt


def main() -> None:
    """Fuzz the reader named first on the command line; what follows is for libFuzzer."""
    warnings.simplefilter("error")
    (reader,) = [reader for reader in READERS if reader.name.replace(" ", "-") == sys.argv[1]]
    # A file in memory: what is written is gone with the process, and nothing waits for a disk.
    folder = Path(tempfile.mkdtemp(dir="/dev/shm" if Path("/dev/shm").is_dir() else None))
    for name, content in reader.beside.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(content)
    corpus = folder / "corpus"
    corpus.mkdir()
    for k, seed in enumerate(reader.seeds):
        (corpus / f"seed-{k}").write_bytes(seed)
    words = folder / "words"
    words.write_text("".join('"' + "".join(f"\\x{b:02x}" for b in w) + '"\n' for w in reader.words))
    path = folder / reader.file

    def one_input(data: bytes) -> None:
        handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
        os.write(handle, data)
        os.close(handle)
        attempt(reader, path)

    atheris.Setup(
        [
            sys.argv[0],
            *([f"-dict={words}"] if reader.words else []),
            "-max_len=2048",
            "-timeout=20",
            "-rss_limit_mb=2048",
            *sys.argv[2:],
            str(corpus),
        ],
        one_input,
    )
    atheris.Fuzz()


if __name__ == "__main__":
    main()
