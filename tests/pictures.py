"""Pictures: read from disk, and where they are bright."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray


def read_grey(path: Path) -> NDArray[np.uint8]:
    """The grey values of a picture that is there."""
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    assert image is not None, path
    return np.asarray(image, np.uint8)


def changed(picture: NDArray[np.uint8], grey: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Where a picture in colour is not the grey one, each pixel of which may be several of it."""
    large = grey.repeat(picture.shape[0] // len(grey), axis=0)
    large = large.repeat(picture.shape[1] // grey.shape[1], axis=1)
    return np.asarray(np.any(picture != large[:, :, None], axis=2))


def centroid(weight: NDArray[np.floating]) -> NDArray[np.float64]:
    """(u, v) of the centre of mass of a picture."""
    v, u = np.indices(weight.shape)
    return np.array([(u * weight).sum(), (v * weight).sum()], np.float64) / float(weight.sum())
