"""One reader under atheris: `python -m tools.fuzz.target NAME FOLDER CORPUS [libFuzzer's flags]`.

atheris is no dependency of the project: `pip install atheris`.
"""

from __future__ import annotations

import os
import sys
import warnings
from pathlib import Path

import atheris  # type: ignore[import-untyped,import-not-found,unused-ignore]

with atheris.instrument_imports(
    include=[
        "camera",
        "detect.draw_head",
        "detect.image_header",
        "detect.resume_journal",
        "detect.sources",
        "landmarks",
        "groundtruth",
        "slam",
        "storage",
        "tools.fuzz",
        "csv",
    ],
    enable_loader_override=False,
):
    from tools.fuzz.reader import attempt
    from tools.fuzz.readers import READERS

#: Files are at most twice as long as the longest that the reader accepts, and at least so long.
_SHORT_BYTES = 2048


def main() -> None:
    """Fuzz the reader named first, in a folder, with a corpus; what follows is for libFuzzer."""
    warnings.simplefilter("error")
    name, folder, corpus = sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3])
    (reader,) = [reader for reader in READERS if reader.name.replace(" ", "-") == name]
    path = reader.prepare(folder)
    seeds = reader.all_seeds()
    for k, seed in enumerate(seeds):
        (corpus / f"seed-{k}").write_bytes(seed)
    words = folder / "words"
    words.write_text("".join('"' + "".join(f"\\x{b:02x}" for b in w) + '"\n' for w in reader.words))

    def one_input(data: bytes) -> None:
        handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
        os.write(handle, data)
        os.close(handle)
        attempt(reader, path)

    atheris.Setup(
        [
            sys.argv[0],
            *([f"-dict={words}"] if reader.words else []),
            f"-max_len={max(_SHORT_BYTES, 2 * max(map(len, seeds)))}",
            "-timeout=20",
            "-rss_limit_mb=2048",
            "-print_final_stats=1",
            f"-artifact_prefix={name}-",
            *sys.argv[4:],
            str(corpus),
        ],
        one_input,
    )
    atheris.Fuzz()


if __name__ == "__main__":
    main()
