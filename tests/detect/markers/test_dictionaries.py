"""Dictionaries of markers against the published code, OpenCV's own drawings and their distances."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from detect.errors import DetectError
from detect.markers.dictionaries import dictionary_names, marker_dictionary, simple_patterns
from tests.pictures import read_grey


def _sampled(picture: NDArray[np.uint8], centres: NDArray[np.float64]) -> NDArray[np.bool_]:
    at = np.floor(centres * len(picture)).astype(int)
    return np.asarray(picture[np.ix_(at, at)] > 127)


@pytest.mark.parametrize(
    ("name", "folder", "stem"),
    [
        ("artoolkitplus12", "bitmaps_std12", "SimpleStd"),
        ("artoolkitplus8", "bitmaps_thin8", "SimpleThin"),
    ],
)
def test_the_simple_code_is_that_of_the_published_drawings(
    shared_data: Path, name: str, folder: str, stem: str
) -> None:
    dictionary = marker_dictionary(name)
    drawings = sorted((shared_data / "rawseeds" / "markers" / folder).glob(f"{stem}_*.png"))
    assert len(drawings) >= 8
    for path in drawings:
        picture = read_grey(path)
        rows, columns = np.nonzero(picture < 128)
        square = picture[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
        assert square.shape[0] == square.shape[1]
        found = _sampled(np.asarray(square, np.uint8), dictionary.centres)
        np.testing.assert_array_equal(found, dictionary.patterns[int(path.stem.split("_")[1])])


def test_the_simple_code_keeps_its_known_distances() -> None:
    # Stated with the code: least distance 4 over ids and rotations, 10 to a marker's own rotations,
    # 12 to 24 white cells of which 18 on average.
    codes = simple_patterns()
    flat = codes.reshape(len(codes), -1)
    white = flat.sum(axis=1)
    assert (white.min(), white.max(), white.mean()) == (12, 24, 18.0)
    least_other, least_own = 36, 36
    for turns in range(4):
        turned = np.rot90(codes, turns, axes=(1, 2)).reshape(len(codes), -1)
        distance = (flat[:, None, :] != turned[None, :, :]).sum(axis=-1)
        own = np.diag(distance)
        if turns:
            least_own = min(least_own, int(own.min()))
        np.fill_diagonal(distance, 36)
        least_other = min(least_other, int(distance.min()))
    assert least_other == 4
    assert least_own == 10


def test_rawseeds_moves_the_matrix_half_a_cell_up_and_to_the_right() -> None:
    dictionary = marker_dictionary("rawseeds")
    np.testing.assert_allclose(dictionary.centres * 24, [6, 8, 10, 12, 14, 16, 18])
    assert not dictionary.patterns[:, :, 0].any()
    assert not dictionary.patterns[:, 6, :].any()
    np.testing.assert_array_equal(dictionary.patterns[:, :6, 1:], simple_patterns())


@pytest.mark.parametrize("name", ["4x4_50", "6x6_250", "apriltag_36h11", "aruco_original"])
def test_opencv_reads_what_the_dictionary_says(name: str) -> None:
    from cv2 import aruco

    dictionary = marker_dictionary(name)
    detector = aruco.ArucoDetector(
        aruco.getPredefinedDictionary(getattr(aruco, "DICT_" + name.upper()))
    )
    cells = 24
    for index in (0, 7, len(dictionary) - 1):
        square = np.kron(dictionary.patterns[index], np.full((cells, cells), 255)).astype(np.uint8)
        picture = np.pad(square, 60, constant_values=255)
        _, ids, _ = detector.detectMarkers(picture)
        assert ids is not None
        assert ids.ravel().tolist() == [dictionary.ids[index]]


@pytest.mark.parametrize("name", dictionary_names())
def test_no_marker_looks_like_another_or_itself_turned(name: str) -> None:
    patterns = marker_dictionary(name).patterns
    turned = {np.rot90(pattern, turns).tobytes() for pattern in patterns for turns in range(4)}
    # One of ArUco's first markers is the same upside down: nothing can tell its orientation.
    symmetric = 2 if name == "aruco_original" else 0
    assert len(turned) == 4 * len(patterns) - symmetric


def test_expected_markers_can_be_chosen() -> None:
    chosen = marker_dictionary("rawseeds").only((31, 7, 31))
    assert chosen.ids.tolist() == [7, 31]
    np.testing.assert_array_equal(chosen.patterns[1], marker_dictionary("rawseeds").patterns[31])
    with pytest.raises(DetectError, match="marker 512: not in rawseeds"):
        marker_dictionary("rawseeds").only((512,))


def test_names_of_other_programs_are_known() -> None:
    for name in ("DICT_APRILTAG_36h11", "tag36h11", "36H11"):
        assert marker_dictionary(name).name == "apriltag_36h11"
    assert marker_dictionary("DICT_4X4_50").name == "4x4_50"
    with pytest.raises(
        DetectError,
        match=r"no such dictionary of markers: 'aprltag_36h11': did you mean apriltag_36h11\?",
    ):
        marker_dictionary("aprltag_36h11")
