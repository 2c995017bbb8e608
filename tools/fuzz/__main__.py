"""Fuzz readers with atheris: `python -m tools.fuzz --help`.

Each reader is fuzzed for the given time in its own process. Inputs that break it are stored as
``NAME-crash-*`` in the working folder. atheris is not a dependency of the project:
`pip install atheris`.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path

from redetect.command_line import exit_code_of

#: Files may be twice as long as the longest seed, and at least this long.
_SHORT_BYTES = 2048
_INSTRUMENTED = (
    "camera", "detect.row_files", "detect.runs.stream", "detect.sources", "redetect",
    "tools.fuzz", "csv",
)  # fmt: skip


def main(arguments: list[str] | None = None) -> int:
    """Fuzz; returns 0 if nothing was found."""
    parser = argparse.ArgumentParser(prog="python -m tools.fuzz", description="Fuzz the readers.")
    parser.add_argument("seconds", type=int, nargs="?", default=20, help="per reader (default: 20)")
    parser.add_argument("names", nargs="*", metavar="NAME", help="- for a space; default: all")
    parser.add_argument("--corpus", type=Path, help="folder to keep the corpora")
    options = parser.parse_args(arguments)
    import atheris  # type: ignore[import-untyped,import-not-found,unused-ignore]

    include = list(_INSTRUMENTED)
    with atheris.instrument_imports(include=include, enable_loader_override=False):
        from tools.fuzz.readers import READERS

    known = {reader.name.replace(" ", "-") for reader in READERS}
    if unknown := set(options.names) - known:
        parser.error(f"no such reader: {', '.join(sorted(unknown))}; one of {sorted(known)}")
    if len(options.names) == 1:
        fuzz(options.names[0], options.seconds, options.corpus)
    found = 0
    for name in options.names or sorted(known):
        print(f"--- {name}", flush=True)
        kept = [] if options.corpus is None else ["--corpus", str(options.corpus)]
        command = [sys.executable, "-m", "tools.fuzz", str(options.seconds), name, *kept]
        found |= subprocess.run(command, check=False).returncode
    return found


def fuzz(name: str, seconds: int, corpora: Path | None) -> None:
    """Fuzz one reader; libFuzzer ends the process."""
    import atheris

    from tools.fuzz.reader import attempt
    from tools.fuzz.readers import READERS

    warnings.simplefilter("error")
    (reader,) = [reader for reader in READERS if reader.name.replace(" ", "-") == name]
    folder = Path(tempfile.mkdtemp(prefix="fuzz-"))
    path = reader.prepare(folder)
    corpus = (folder if corpora is None else corpora) / f"corpus-{name}"
    corpus.mkdir(parents=True, exist_ok=True)
    for number, seed in enumerate(reader.all_seeds()):
        (corpus / f"seed-{number}").write_bytes(seed)
    words = folder / "words"
    words.write_text(
        "".join('"' + "".join(f"\\x{b:02x}" for b in word) + '"\n' for word in reader.words)
    )
    longest = max(map(len, reader.all_seeds()), default=0)

    def one_input(data: bytes) -> None:
        path.write_bytes(reader.content(data))
        attempt(reader, path)

    flags = [
        f"-max_total_time={seconds}", f"-max_len={max(_SHORT_BYTES, 2 * longest)}", "-timeout=20",
        "-rss_limit_mb=2048", "-print_final_stats=1", f"-artifact_prefix={name}-",
        f"-dict={words}", str(corpus),
    ]  # fmt: skip
    atheris.Setup([sys.argv[0], *flags], one_input)
    atheris.Fuzz()


if __name__ == "__main__":
    sys.exit(exit_code_of(main))
