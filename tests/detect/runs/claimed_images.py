"""Image files whose headers claim a size that their content does not have."""

from __future__ import annotations

import struct
import zlib

import cv2
import numpy as np

TEXTURE = np.random.default_rng(3).integers(0, 256, (48, 96)).astype(np.uint8)
SIDE = 60_000


def jpeg(width: int, height: int) -> bytes:
    content = bytearray(cv2.imencode(".jpg", TEXTURE)[1].tobytes())
    frame = content.index(b"\xff\xc0")
    content[frame + 5 : frame + 9] = struct.pack(">HH", height, width)
    return bytes(content)


def png(width: int, height: int) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        crc = struct.pack(">I", zlib.crc32(kind + data))
        return struct.pack(">I", len(data)) + kind + data + crc

    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0))
        + chunk(b"IDAT", zlib.compress(bytes(1000)))
        + chunk(b"IEND", b"")
    )


def pnm(width: int, height: int) -> bytes:
    return f"P5\n# made by hand\n{width} {height}\n255\n".encode() + bytes(1000)


def bmp(width: int, height: int) -> bytes:
    content = bytearray(cv2.imencode(".bmp", TEXTURE)[1].tobytes())
    content[18:26] = struct.pack("<ii", width, -height)
    return bytes(content)


def tiff(width: int, height: int, order: str = "<", tile: int = 0, big: bool = False) -> bytes:
    mark = b"II" if order == "<" else b"MM"
    sizes = [(256, width), (257, height), *([(322, tile), (323, tile)] if tile else [])]
    if big:
        head = mark + struct.pack(order + "HHHQ", 43, 8, 0, 16)
        entries = [struct.pack(order + "HHQQ", tag, 16, 1, value) for tag, value in sizes]
        return head + struct.pack(order + "Q", len(entries)) + b"".join(entries) + bytes(100)
    head = mark + struct.pack(order + "HI", 42, 8)
    entries = [struct.pack(order + "HHII", tag, 4, 1, value) for tag, value in sizes]
    return head + struct.pack(order + "H", len(entries)) + b"".join(entries) + bytes(100)
