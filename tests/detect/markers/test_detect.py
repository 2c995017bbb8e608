"""The detector of square markers on renders whose truth is exact, and on a real frame."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from camera import Camera
from camera.uncertainty import IDENTITY
from detect.errors import DetectError, FrameError
from detect.markers import candidates as regions
from detect.markers import detect as identities
from detect.markers import edges, geometry
from detect.markers.detect import MarkerDetections, detect_markers
from detect.markers.dictionaries import dictionary_names, marker_dictionary
from detect.settings import MarkerSettings
from tests.detect.markers.rendering import View, corners_of, exposed, pinhole, render
from tests.pictures import read_grey

FloatArray = NDArray[np.float64]

ARUCO = MarkerSettings(dictionary="6x6_250")


def picture(
    number: int = 7,
    *,
    dictionary: str = "6x6_250",
    view: View | None = None,
    size: tuple[int, int] = (160, 140),
    noise: float = 2.0,
    seed: int = 0,
    blur: float = 0.8,
    dark: float = 40.0,
    light: float = 200.0,
    background: float | FloatArray = 120.0,
    quiet_cells: float = 1.5,
    gradient: tuple[float, float] = (0.0, 0.0),
    motion: tuple[float, float] = (0.0, 0.0),
) -> tuple[NDArray[np.uint8], FloatArray]:
    """A marker in the middle of an image, and its corners."""
    view = View(60.0, 35.0, 20.0, 33.0) if view is None else view
    camera = pinhole(*size)
    pose = view.pose(camera, (size[0] / 2 + 0.3, size[1] / 2 - 0.2))
    grey = render(
        camera, [(dictionary, number, pose)], dark=dark, light=light, background=background,
        quiet_cells=quiet_cells, blur=blur, gradient=gradient, motion=motion,
    )  # fmt: skip
    return exposed(grey, noise, np.random.default_rng(seed)), corners_of(camera, pose)


def normalised_error(found: MarkerDetections, corners: FloatArray) -> float:
    """Mean squared error of the first marker's corners by its covariance: 1 if that is right."""
    apart = found.corners[0] - corners
    return float(
        np.einsum("ki,kij,kj->", apart, np.linalg.inv(found.covariance[0]), apart) / apart.size
    )


@pytest.mark.parametrize("name", dictionary_names())
def test_a_marker_of_every_dictionary_is_found(name: str) -> None:
    dictionary = marker_dictionary(name)
    number = int(dictionary.ids[len(dictionary) // 3])
    image, corners = picture(number, dictionary=name, view=View(80.0, 30.0, 70.0, 200.0))
    found = detect_markers(image, MarkerSettings(dictionary=name))
    assert found.ids.tolist() == [number]
    assert np.abs(found.corners[0] - corners).max() < 0.06
    assert found.quality[0] > 0.95


@pytest.mark.parametrize("roll_deg", [0.0, 90.0, 180.0, 270.0, 37.0, 211.0])
def test_corners_come_in_the_printed_order(roll_deg: float) -> None:
    image, corners = picture(view=View(50.0, 20.0, 60.0, roll_deg))
    found = detect_markers(image, ARUCO)
    assert found.ids.tolist() == [7]
    assert np.abs(found.corners[0] - corners).max() < 0.1


@pytest.mark.parametrize(
    ("view", "options", "tolerance_px"),
    [
        (View(18.0, 10.0, 50.0, 20.0), {"noise": 3.0}, 0.12),
        (View(200.0, 40.0, 10.0, 70.0), {"size": (320, 320)}, 0.03),
        (View(70.0, 70.0, 35.0, 15.0), {}, 0.04),
        (View(90.0, 20.0, 35.0, 15.0), {"blur": 3.0}, 0.1),
        (View(60.0, 20.0, 35.0, 15.0), {"dark": 110.0, "light": 125.0, "noise": 3.0}, 0.4),
        (View(60.0, 20.0, 35.0, 15.0), {"gradient": (0.8, -0.5)}, 0.03),
        (View(60.0, 20.0, 35.0, 15.0), {"light": 300.0}, 0.03),
        (View(80.0, 20.0, 35.0, 15.0), {"motion": (5.0, 3.0)}, 0.07),
        (View(60.0, 0.0, 0.0, 0.0), {"blur": 0.0, "noise": 0.5}, 0.06),
    ],
    ids=["small", "large", "slanted", "soft", "faint", "uneven", "saturated", "moving", "sharp"],
)
def test_corners_are_where_they_were_drawn(
    view: View, options: dict[str, float], tolerance_px: float
) -> None:
    image, corners = picture(view=view, **options)  # type: ignore[arg-type]
    found = detect_markers(image, ARUCO)
    assert found.ids.tolist() == [7]
    assert np.abs(found.corners[0] - corners).max() < tolerance_px


def test_covariances_are_right() -> None:
    # 40 independent images: the mean of 8 * 40 normalised squared errors, which hang together
    # within an image, is within 0.43 of 1.
    settings = MarkerSettings(dictionary="6x6_250", systematic_px=0.0)
    errors = []
    for seed in range(40):
        rng = np.random.default_rng(1000 + seed)
        view = View(50.0 + 20.0 * rng.random(), 45.0 * rng.random(), *(360.0 * rng.random(2)))
        image, corners = picture(view=view, noise=4.0, seed=seed, background=200.0)
        found = detect_markers(image, settings)
        assert found.ids.tolist() == [7]
        errors.append(normalised_error(found, corners))
    assert 0.57 < np.mean(errors) < 1.43


@pytest.mark.parametrize("width", [15.0, 16.0, 17.0, 18.0])
def test_small_sharpened_tags_are_found(width: float) -> None:
    # Clear edges of few pixels, between which undamped steps of a fit go back and forth.
    camera = pinhole(80, 80)
    for roll_deg in (0.0, 3.0, 10.0, 33.0):
        pose = View(width, 20.0, 40.0, roll_deg).pose(camera, (40.3, 39.8))
        grey = render(camera, [("apriltag_36h11", 0, pose)], blur=0.3)
        sharp = grey + 0.7 * (grey - cv2.GaussianBlur(grey, (0, 0), 1.0))
        image = exposed(np.asarray(sharp), 0.7, np.random.default_rng(0))
        found = detect_markers(image, MarkerSettings(dictionary="apriltag_36h11"))
        assert found.ids.tolist() == [0]
        assert np.abs(found.corners[0] - corners_of(camera, pose)).max() < 0.15


@pytest.mark.parametrize("width", [16.0, 22.0, 30.0, 48.0])
def test_tags_with_a_seam_of_white_are_found_on_dark_ground(width: float) -> None:
    # As they are cut out of a sheet: the ground is as dark as the tag, on all sides or on some.
    camera = pinhole(100, 100)
    rng = np.random.default_rng(3)
    for roll_deg in (3.0, 33.0, 70.0):
        pose = View(width, 25.0, 40.0, roll_deg).pose(camera, (50.3, 49.8))
        ground = 25.0 + 20.0 * cv2.GaussianBlur(rng.normal(size=(100, 100)), (0, 0), 2.0)
        for bright in (100, 45):
            ground[:, bright:] += 130.0
            grey = render(
                camera, [("apriltag_36h11", 5, pose)], background=np.asarray(ground),
                quiet_cells=0.5, blur=0.6,
            )  # fmt: skip
            image = exposed(grey, 1.5, rng)
            found = detect_markers(image, MarkerSettings(dictionary="apriltag_36h11"))
            assert found.ids.tolist() == [5]
            assert np.abs(found.corners[0] - corners_of(camera, pose)).max() < 0.2


def test_the_tone_curve_of_a_camera_moves_no_corner() -> None:
    view = View(90.0, 35.0, 20.0, 33.0)
    light, corners = picture(view=view, dark=12.0, light=180.0, background=60.0, noise=0.0)
    image = exposed(255.0 * (light / 255.0) ** (1.0 / 2.2), 2.0, np.random.default_rng(0))
    found = detect_markers(image, ARUCO)
    assert np.abs(found.corners[0] - corners).max() < 0.06
    assert normalised_error(found, corners) < 3.0


@pytest.mark.parametrize("quiet_cells", [0.2, 0.4])
@pytest.mark.parametrize("background", [50.0, 110.0])
def test_a_narrow_quiet_zone_moves_no_corner(quiet_cells: float, background: float) -> None:
    image, corners = picture(quiet_cells=quiet_cells, background=background)
    found = detect_markers(image, ARUCO)
    assert np.abs(found.corners[0] - corners).max() < 0.08
    assert normalised_error(found, corners) < 3.0


def test_sixty_pixels_wide_at_noise_three() -> None:
    errors = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        view = View(60.0, 60.0 * rng.random(), *(360.0 * rng.random(2)))
        image, corners = picture(view=view, noise=3.0, seed=seed)
        found = detect_markers(image, ARUCO)
        assert found.ids.tolist() == [7]
        errors.append(np.linalg.norm(found.corners[0] - corners, axis=-1))
    assert np.median(errors) <= 0.05


def test_a_quarter_turn_of_the_image_turns_the_result() -> None:
    image, _ = picture()
    upright = detect_markers(image, ARUCO)
    turned = detect_markers(np.rot90(image), ARUCO)
    assert turned.ids.tolist() == upright.ids.tolist() == [7]
    # (u, v) of the turned image is (v, W - 1 - u) of the upright one.
    back = np.stack(
        [image.shape[1] - 1.0 - turned.corners[0, :, 1], turned.corners[0, :, 0]], axis=-1
    )
    assert np.abs(back - upright.corners[0]).max() < 0.02


def test_brightness_and_contrast_do_not_matter() -> None:
    image, _ = picture(noise=2.0)
    darker = np.rint(image * 0.5 + 60.0).astype(np.uint8)
    first, second = detect_markers(image, ARUCO), detect_markers(darker, ARUCO)
    assert first.ids.tolist() == second.ids.tolist() == [7]
    assert np.abs(first.corners - second.corners).max() < 0.02


def test_several_markers_of_several_sizes() -> None:
    camera = pinhole(256, 200)
    places = {3: (75.0, 85.0, 85.0), 40: (190.0, 60.0, 45.0), 200: (190.0, 150.0, 25.0)}
    poses = {
        number: View(width, 25.0, 40.0, 10.0 * number).pose(camera, (u, v))
        for number, (u, v, width) in places.items()
    }
    grey = render(camera, [("6x6_250", n, pose) for n, pose in poses.items()], blur=0.7)
    found = detect_markers(exposed(grey, 2.0, np.random.default_rng(0)), ARUCO)
    assert found.ids.tolist() == sorted(places)
    for number, corners in zip(found.ids, found.corners):
        assert np.abs(corners - corners_of(camera, poses[int(number)])).max() < 0.15


@pytest.mark.parametrize(
    ("coef", "polynomial"),
    [
        ((-0.0620672, -0.324903, 0.314764, 1.52524, -0.480806), (0.0, 0.0, 0.0)),
        ((0.0, 0.0, 0.0, 0.0, 0.0), (-0.3, 0.0, 0.0)),  # folds in the corners of the image
    ],
)
def test_distortion_is_taken_off(
    coef: tuple[float, float, float, float, float], polynomial: tuple[float, float, float]
) -> None:
    camera = Camera(320, 240, 200.0, 200.0, 159.5, 119.5, coef, IDENTITY, polynomial=polynomial)
    assert (camera.seen_share < 0.95) == any(polynomial)
    pose = View(70.0, 20.0, 40.0, 15.0).pose(camera, (255.0, 70.0))
    grey = render(camera, [("6x6_250", 7, pose)], background=200.0, blur=0.7)
    image = exposed(grey, 1.0, np.random.default_rng(0))
    corners = corners_of(camera, pose)
    with_camera = detect_markers(image, ARUCO, camera)
    assert with_camera.ids.tolist() == [7]
    assert np.abs(with_camera.corners[0] - corners).max() < 0.08
    without = detect_markers(image, ARUCO)
    if len(without):
        assert np.abs(without.corners[0] - corners).max() > 0.15


def test_what_is_hidden_in_part_is_found_or_refused() -> None:
    rng = np.random.default_rng(5)
    found_some = 0
    for seed in range(20):
        image, corners = picture(seed=seed)
        middle = corners[rng.integers(4)] * 0.7 + corners.mean(axis=0) * 0.3
        radius = int(rng.integers(3, 14))
        cv2.circle(image, (round(middle[0]), round(middle[1])), radius, int(rng.integers(256)), -1)
        found = detect_markers(image, ARUCO)
        assert set(found.ids.tolist()) <= {7}
        if len(found):
            found_some += 1
            assert np.abs(found.corners[0] - corners).max() < 0.5
    assert found_some


# -- what is rejected, and why ----------------------------------------------------------------


def squares(image: NDArray[np.uint8], settings: MarkerSettings = ARUCO) -> MarkerDetections:
    found = detect_markers(image, settings)
    assert len(found) == 0
    return found


def painted(grey: FloatArray, blur: float = 0.8) -> NDArray[np.uint8]:
    soft = cv2.GaussianBlur(grey, (0, 0), blur)
    return exposed(np.asarray(soft), 1.0, np.random.default_rng(0))


def test_an_unknown_pattern_is_like_none() -> None:
    image, _ = picture(31, dictionary="7x7_50", view=View(80.0))
    only = MarkerSettings(dictionary="6x6_250", ids=(3, 5))
    found = squares(image, only)
    causes = {identities.NO_PATTERN, identities.UNEXPLAINED, identities.WRONG_CELLS}
    assert causes & set(found.rejected)


def test_a_black_square_is_no_marker() -> None:
    grey = np.full((120, 120), 200.0)
    grey[40:80, 40:80] = 40.0
    found = squares(painted(grey))
    assert identities.NO_PATTERN in found.rejected


@pytest.mark.parametrize("name", ["4x4_1000", "apriltag_16h5", "aruco_original"])
def test_frames_panes_and_chessboards_are_no_markers(name: str) -> None:
    settings = MarkerSettings(dictionary=name)
    for panes in range(1, 6):
        for bar in (2, 4, 8):
            grey = np.full((140, 140), 200.0)
            grey[30:110, 30:110] = 40.0
            inner = np.linspace(30 + bar, 110, panes + 1).round().astype(int)
            for top, bottom in itertools.pairwise(inner):
                for left, right in itertools.pairwise(inner):
                    grey[top : bottom - bar, left : right - bar] = 200.0
            squares(painted(grey), settings)
    for side in (6, 10, 16):
        v, u = np.mgrid[0:160, 0:160]
        board = np.where((u // side + v // side) % 2 == 0, 40.0, 200.0)
        squares(painted(board), settings)


def test_a_marker_without_white_round_it_is_refused() -> None:
    image, _ = picture(background=40.0, quiet_cells=0.0)
    assert sum(squares(image).rejected.values()) > 0


def test_a_marker_at_the_border_is_counted() -> None:
    image, corners = picture()
    cut = np.ascontiguousarray(image[:, round(corners[:, 0].min()) + 4 :])
    assert regions.AT_THE_BORDER in squares(cut).rejected


def test_a_disc_is_no_quadrangle() -> None:
    grey = np.full((120, 120), 200.0)
    cv2.circle(grey, (60, 60), 30, 40.0, -1)
    assert geometry.NO_QUADRANGLE in squares(painted(grey)).rejected


def test_a_ring_segment_is_not_solid() -> None:
    grey = np.full((120, 120), 200.0)
    cv2.ellipse(grey, (60, 60), (35, 35), 0, 0, 200, 40.0, 6)
    assert regions.SOLIDITY in squares(painted(grey)).rejected


def test_the_filters_count_holes_and_their_share() -> None:
    grey = np.full((120, 120), 200.0)
    grey[40:80, 40:80] = 40.0
    grey[50:70, 50:70] = 200.0
    none = MarkerSettings(dictionary="6x6_250", thresholds=(0.5,), most_holes=0)
    assert regions.HOLES in squares(painted(grey), none).rejected
    little = MarkerSettings(dictionary="6x6_250", thresholds=(0.5,), most_white=0.1)
    assert regions.WHITE_SHARE in squares(painted(grey, blur=0.3), little).rejected


def test_cells_too_small_for_the_blur_are_not_guessed() -> None:
    image, _ = picture(view=View(24.0), blur=2.6, noise=0.3)
    found = squares(image)
    assert {identities.TOO_SMALL, identities.NO_PATTERN, edges.NO_EDGE} & set(found.rejected)


def test_a_marker_that_is_its_own_half_turn_is_ambiguous() -> None:
    # One pattern of the oldest set looks the same after half a turn.
    dictionary = marker_dictionary("aruco_original")
    turned = np.rot90(dictionary.patterns, 2, axes=(1, 2))
    same = np.flatnonzero((turned == dictionary.patterns).all(axis=(1, 2)))
    assert len(same)
    image, _ = picture(int(dictionary.ids[same[0]]), dictionary="aruco_original", view=View(80.0))
    found = squares(image, MarkerSettings(dictionary="aruco_original"))
    assert identities.AMBIGUOUS in found.rejected


def test_noise_alone_and_flat_images_hold_no_marker() -> None:
    rng = np.random.default_rng(0)
    for image in (
        rng.integers(0, 256, (120, 160)).astype(np.uint8),
        np.zeros((120, 160), np.uint8),
        np.full((120, 160), 255, np.uint8),
        np.full((17, 16), 128, np.uint8),
        np.full((2, 2), 128, np.uint8),
    ):
        squares(image)


# -- settings -----------------------------------------------------------------------------------


def test_expected_ids_and_width_narrow_the_search() -> None:
    image, corners = picture()
    for settings in (
        MarkerSettings(dictionary="6x6_250", ids=(7, 9)),
        MarkerSettings(dictionary="6x6_250", width_px=60.0),
        MarkerSettings(dictionary="6x6_250", width_px=40.0),
    ):
        found = detect_markers(image, settings)
        assert found.ids.tolist() == [7]
        assert np.abs(found.corners[0] - corners).max() < 0.06
    assert len(detect_markers(image, MarkerSettings(dictionary="6x6_250", ids=(9, 11)))) == 0
    assert len(detect_markers(image, MarkerSettings(dictionary="6x6_250", width_px=300.0))) == 0


@pytest.mark.parametrize("width_px", [200.0, 1e6, 1e24])
def test_markers_much_wider_than_the_image(width_px: float) -> None:
    image = np.tile(np.array([0, 255], np.uint8), (2, 25))
    assert len(detect_markers(image, MarkerSettings(width_px=width_px))) == 0


def test_unknown_dictionaries_and_ids_and_sizes_are_refused(published_camera: Camera) -> None:
    image, _ = picture()
    with pytest.raises(DetectError, match="no such dictionary"):
        detect_markers(image, MarkerSettings(dictionary="8x8"))
    with pytest.raises(DetectError, match="marker 999"):
        detect_markers(image, MarkerSettings(dictionary="6x6_250", ids=(999,)))
    with pytest.raises(FrameError, match="the calibration is for 768x288"):
        detect_markers(image, ARUCO, published_camera)


# -- real images ----------------------------------------------------------------------------------


def real_frame(shared_data: Path) -> tuple[NDArray[np.uint8], FloatArray]:
    stem = shared_data / "rawseeds" / "markers" / "image_320_240_8_marker_id_simple_nr031"
    image = read_grey(Path(f"{stem}.png"))
    truth = json.loads(Path(f"{stem}.truth.json").read_text())
    return image, np.array(truth["markers"][0]["corners_TL_TR_BR_BL"])


def test_the_real_frame(shared_data: Path) -> None:
    image, corners = real_frame(shared_data)
    found = detect_markers(image, MarkerSettings(dictionary="artoolkitplus12"))
    assert found.ids.tolist() == [31]
    assert np.abs(found.corners[0] - corners).max() < 0.1


@pytest.mark.parametrize("reduction", [2, 3])
def test_the_real_frame_reduced(shared_data: Path, reduction: int) -> None:
    image, corners = real_frame(shared_data)
    size = (image.shape[1] // reduction, image.shape[0] // reduction)
    small = cv2.resize(
        image[: size[1] * reduction, : size[0] * reduction], size, interpolation=cv2.INTER_AREA
    )
    found = detect_markers(
        np.asarray(small, np.uint8), MarkerSettings(dictionary="artoolkitplus12")
    )
    assert found.ids.tolist() == [31]
    expected = (corners - 0.5 * (reduction - 1)) / reduction
    assert np.abs(found.corners[0] - expected).max() < 0.3


def test_tags_outdoors(shared_data: Path) -> None:
    # Of 47 tags, all of the same number, OpenCV's detector with sub-pixel refinement finds 36.
    listed = 0
    for path in sorted((shared_data / "apriltag").glob("*.jpg")):
        image = read_grey(path)
        found = detect_markers(image, MarkerSettings(dictionary="apriltag_36h11"))
        assert set(found.ids.tolist()) == {0}
        for line in path.with_suffix(".txt").read_text().splitlines():
            numbers = [float(word.strip("(),")) for word in line.split()]
            corners = np.array(numbers[1:]).reshape(4, 2)
            apart = np.abs(found.corners[:, :, None] - corners).max(axis=-1).min(axis=-1)
            listed += int(np.any(apart.max(axis=-1) < 1.5))
    assert listed >= 40


@pytest.mark.long
@pytest.mark.parametrize("name", ["rawseeds", "4x4_50", "apriltag_16h5"])
def test_photographs_without_markers(shared_data: Path, name: str) -> None:
    settings = MarkerSettings(dictionary=name)
    paths = sorted((shared_data / "york").glob("**/images/*.jpg"))[::9]
    assert paths
    for path in paths:
        image = read_grey(path)
        assert len(detect_markers(image, settings)) == 0, path
