"""Readers under atheris: `python -m tools.fuzz.target NAMES FOLDER CORPUS [libFuzzer's flags]`.

NAMES has commas between. With several, the first byte of an input says which of them reads the
rest. ``FOLDER/counts.json`` says how many files each of them has read, now and then, and which
file's reader broke off. atheris is no dependency of the project: `pip install atheris`.
"""

from __future__ import annotations

import json
import os
import sys
import warnings
from pathlib import Path

import atheris  # type: ignore[import-untyped,import-not-found,unused-ignore]

with atheris.instrument_imports(
    include=[
        "camera",
        "detect.drawing.inputs",
        "detect.runs.journal",
        "detect.sources",
        "redetect",
        "tools.fuzz",
        "csv",
    ],
    enable_loader_override=False,
):
    from tools.fuzz.reader import attempt
    from tools.fuzz.readers import READERS

#: Files are at most twice as long as the longest that a reader accepts, and at least so long.
_SHORT_BYTES = 2048
_COUNT_EVERY = 200


def main() -> None:
    """Fuzz readers in a folder, with a corpus; further flags are libFuzzer's."""
    warnings.simplefilter("error")
    names, folder, corpus = sys.argv[1].split(","), Path(sys.argv[2]), Path(sys.argv[3])
    known = {reader.name.replace(" ", "-"): reader for reader in READERS}
    chosen = [known[name] for name in names]
    places = []
    longest = 0
    for number, (name, reader) in enumerate(zip(names, chosen)):
        (folder / name).mkdir()
        places.append(reader.prepare(folder / name))
        which = bytes([number]) if len(chosen) > 1 else b""
        for k, seed in enumerate(reader.all_seeds()):
            (corpus / f"seed-{name}-{k}").write_bytes(which + seed)
            longest = max(longest, 1 + len(seed))
    words = folder / "words"
    listed = dict.fromkeys(word for reader in chosen for word in reader.words)
    words.write_text("".join('"' + "".join(f"\\x{b:02x}" for b in w) + '"\n' for w in listed))
    counts = dict.fromkeys(names, 0)
    total = 0

    def tell(faulty: str | None) -> None:
        part = folder / "counts.part"
        part.write_text(json.dumps({"counts": counts, "faulty": faulty}))
        part.replace(folder / "counts.json")

    def one_input(data: bytes) -> None:
        nonlocal total
        which = 0
        if len(chosen) > 1:
            which, data = data[0] % len(chosen) if data else 0, data[1:]
        counts[names[which]] += 1
        total += 1
        content = chosen[which].content_of(data)
        handle = os.open(places[which], os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
        os.write(handle, content)
        os.close(handle)
        try:
            attempt(chosen[which], places[which])
        except BaseException:
            (folder / "input").write_bytes(data)
            tell(names[which])
            raise
        if total % _COUNT_EVERY == 0:
            tell(None)

    atheris.Setup(
        [
            sys.argv[0],
            *([f"-dict={words}"] if listed else []),
            f"-max_len={max(_SHORT_BYTES, 2 * longest)}",
            "-timeout=20",
            "-rss_limit_mb=2048",
            "-print_final_stats=1",
            f"-artifact_prefix={folder}/",
            *sys.argv[4:],
            str(corpus),
        ],
        one_input,
    )
    atheris.Fuzz()


if __name__ == "__main__":
    main()
