"""Damage to files, by chance."""

from __future__ import annotations

import random
from collections.abc import Sequence


def damaged(content: bytes, words: Sequence[bytes], chance: random.Random) -> bytes:
    """Change a file in one to four places: bits, pieces left out, doubled or put elsewhere, words.

    Parameters
    ----------
    content : bytes
    words : sequence of bytes
        What may be put into it.
    chance : random.Random

    Returns
    -------
    bytes
    """
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
