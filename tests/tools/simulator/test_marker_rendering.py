"""The marker renderer against exact areas, projections and profiles."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.special import erf

from camera import Camera
from detect.markers.dictionaries import dictionary_names, marker_dictionary
from redetect.array_types import FloatArray
from tests.pictures import centroid
from tools.simulator.markers.rendering import (
    Imaging,
    exact_grey,
    grey_image,
    pixel_rays,
    render_light,
    surface_arrays,
    uneven_light,
)
from tools.simulator.markers.samples import random_pose, sample_cameras
from tools.simulator.markers.surface import (
    BLACK,
    WHITE,
    Surface,
    Texture,
    box_sides,
    marker_surface,
    marker_texture,
    near_pattern,
    pattern_distance,
    plain,
    pose_of,
    square_corners,
)
from tools.simulator.markers.truth import marker_corners, mean_side_px, slant_deg, visible_shares
from tools.simulator.single_disc import polygon_coverage

WIDTH, HEIGHT = 320, 240


@pytest.fixture(scope="module", params=[0, 1, 2], ids=["pinhole", "lens", "wide"])
def camera(request: pytest.FixtureRequest) -> Camera:
    return sample_cameras(WIDTH, HEIGHT)[int(request.param)]


@pytest.fixture(scope="module")
def pinhole() -> Camera:
    return sample_cameras(WIDTH, HEIGHT)[0]


def _dark() -> NDArray[np.float32]:
    return np.zeros((HEIGHT, WIDTH), np.float32)


def _facing(x: float, y: float, z: float) -> FloatArray:
    """camera_from_surface of a surface parallel to the image, upright."""
    return pose_of([1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [x, y, z])


def _exact_coverage(camera: Camera, surface: Surface) -> FloatArray:
    """Covered area of each pixel, by the outline's own projection."""
    ticks = np.linspace(0.0, 1.0, 400, endpoint=False)[:, None]
    corners = surface.corners()
    outline = np.concatenate(
        [corners[k] + ticks * (corners[(k + 1) % 4] - corners[k]) for k in range(4)]
    )
    pixels = camera.project(outline) + 0.5  # from pixel centres to the corner of the image
    return np.abs(polygon_coverage(pixels[:, 0].copy(), pixels[:, 1].copy(), WIDTH, HEIGHT))


def test_rays_are_linear_within_a_pixel_to_a_thousandth(camera: Camera) -> None:
    rng = np.random.default_rng(4)
    v, u = rng.integers(0, HEIGHT, 500), rng.integers(0, WIDTH, 500)
    offset = rng.uniform(-0.5, 0.5, (500, 2))
    rays = pixel_rays(camera)[v, u]
    moved = rays[:, :2] + np.column_stack(
        [(rays[:, 2:4] * offset).sum(axis=1), (rays[:, 4:6] * offset).sum(axis=1)]
    )
    back = camera.distort(moved)
    assert np.abs(back - (np.column_stack([u, v]) + offset)).max() < 1e-3


@pytest.mark.parametrize("turn_deg", [0.0, 1.0, 13.0, 45.0])
@pytest.mark.parametrize("slant", [0.0, 50.0])
@pytest.mark.parametrize("samples", [16, 64])
def test_a_square_covers_its_exact_area(
    camera: Camera, turn_deg: float, slant: float, samples: int
) -> None:
    a, b = np.radians([turn_deg, slant])
    x = np.array([np.cos(a), np.sin(a), 0.0])
    y = np.array([np.sin(a) * np.cos(b), -np.cos(a) * np.cos(b), np.sin(b)])
    surface = Surface(pose_of(x, y, [0.413, -0.207, 2.0]), 0.6, 0.6, plain(1.0))
    light = render_light(camera, [[surface]], _dark(), fine=False, samples=samples)
    exact = _exact_coverage(camera, surface)
    assert exact.sum() > 600.0
    # As many rays go through each quarter of an edge's pixel.
    assert np.abs(light - exact).max() < 2.5 / samples
    on_edge = (exact > 0.0) & (exact < 1.0)
    assert np.abs(light - exact).sum() < 0.2 / samples * on_edge.sum()
    np.testing.assert_allclose(light.sum(dtype=np.float64), exact.sum(), rtol=0.03 / samples)
    off = centroid(light.astype(np.float64)) - centroid(exact)
    assert np.abs(off).max() < 0.15 / samples


def test_fine_and_coarse_light_agree(camera: Camera) -> None:
    surface = Surface(_facing(0.1, 0.2, 1.7), 0.35, 0.22, plain(0.8))
    fine = render_light(camera, [[surface]], _dark() + np.float32(0.25))
    coarse = render_light(camera, [[surface]], _dark() + np.float32(0.25), fine=False)
    assert fine.shape == (2 * HEIGHT, 2 * WIDTH)
    quarters = fine.reshape(HEIGHT, 2, WIDTH, 2).mean(axis=(1, 3))
    np.testing.assert_allclose(coarse, quarters, atol=1e-6)


def test_half_pixel_convention(pinhole: Camera) -> None:
    """The upper left pixel's centre is (0, 0): a square that covers pixels 100..109 exactly."""
    z = 2.0
    low = pinhole.undistort([99.5, 49.5]) * z
    high = pinhole.undistort([109.5, 59.5]) * z
    centre, size = 0.5 * (low + high), high - low
    pose = _facing(float(centre[0]), float(centre[1]), z)
    surface = Surface(pose, size[0], size[1], plain(1.0))
    light = render_light(pinhole, [[surface]], _dark(), fine=False)
    expected = _dark()
    expected[50:60, 100:110] = 1.0
    np.testing.assert_allclose(light, expected, atol=1e-6)
    # The optics keep it where it is.
    fine = render_light(pinhole, [[surface]], _dark())
    for blur in (0.0, 0.3, 0.79, 1.5, 3.0):
        settings = Imaging(blur_px=blur, black_level=0.0, gain=1.0)
        grey = exact_grey(fine if settings.fine else light, 1.0, settings)
        np.testing.assert_allclose(centroid(grey.astype(np.float64)), [104.5, 54.5], atol=1e-4)
        np.testing.assert_allclose(grey.sum(dtype=np.float64), 100.0, rtol=1e-5)


@pytest.mark.parametrize("blur_px", [0.3, 0.5, 0.7, 0.9, 1.6, 3.0])
def test_edge_profile_is_the_one_of_the_optics(pinhole: Camera, blur_px: float) -> None:
    """An edge at a known place has the profile of a Gaussian over pixels of width 1."""
    z = 3.0
    settings = Imaging(blur_px=blur_px, black_level=20.0, gain=100.0)
    for edge_u in (100.0, 100.21, 100.5, 100.87):
        left = pinhole.undistort([edge_u, 0.0])[0] * z
        surface = Surface(_facing(left + 1.0, 0.0, z), 2.0, 2.0, plain(1.0))
        light = render_light(pinhole, [[surface]], _dark(), fine=settings.fine, samples=64)
        row = exact_grey(light, 1.0, settings)[100:140].mean(axis=0)[80:121]
        u = np.arange(80, 121)

        def integral(x: FloatArray, sigma: float) -> FloatArray:
            """Of the blurred step, whose differences over a pixel are what it sees."""
            y = x / sigma
            return np.asarray(
                0.5 * (x * (1.0 + erf(y / np.sqrt(2.0))))
                + sigma * np.exp(-0.5 * y * y) / np.sqrt(2.0 * np.pi)
            )

        def expected(p: FloatArray, u: NDArray[np.int64] = u) -> FloatArray:
            x = u - p[0]
            return 20.0 + 100.0 * (integral(x + 0.5, p[1]) - integral(x - 0.5, p[1]))

        fit = least_squares(lambda p, row=row: expected(p) - row, [edge_u + 0.1, blur_px + 0.1])
        # Where the edge lies on the grid makes the blur's discrete sum a little wider or narrower.
        assert abs(fit.x[0] - edge_u) < 0.006
        assert abs(fit.x[1] - blur_px) < 0.1
        assert np.abs(fit.fun).max() < 0.5


def test_nearest_surface_wins_in_any_order(camera: Camera) -> None:
    near = Surface(_facing(0.0, 0.0, 1.0), 0.3, 0.3, plain(0.2), 0.9)
    far = Surface(_facing(0.05, 0.0, 2.0), 1.2, 1.2, plain(0.7), 0.9)
    one = render_light(camera, [[near, far]], _dark())
    other = render_light(camera, [[far, near]], _dark())
    np.testing.assert_array_equal(one, other)
    u, v = np.rint(2.0 * camera.project([0.0, 0.0, 1.0])).astype(int)
    assert one[v, u] == np.float32(0.2)


def test_backs_and_holes(pinhole: Camera) -> None:
    front = _facing(0.0, 0.0, 1.0)
    behind = pose_of([-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0])
    values = np.array([[0.3, np.nan], [0.5, 0.7]], np.float32)
    u, v = np.rint(pinhole.project([0.0, 0.0, 1.0])).astype(int)
    for pose, back, expected in (
        (front, np.nan, [[0.3, 0.0], [0.5, 0.7]]),
        (behind, np.nan, [[0.0, 0.0], [0.0, 0.0]]),
        (behind, 0.4, [[0.0, 0.4], [0.4, 0.4]]),
    ):
        surface = Surface(pose, 0.3, 0.3, Texture(values), back)
        light = render_light(pinhole, [[surface]], _dark(), fine=False)
        seen = light[v - 20 : v + 21 : 40, u - 20 : u + 21 : 40]
        np.testing.assert_array_equal(seen, np.array(expected, np.float32))


def test_a_box_shows_its_outside_only(pinhole: Camera) -> None:
    sides = ("front", "rear", "left", "right", "top")
    box = box_sides([0.4, 0.3, 0.2], {side: plain(0.1 + 0.1 * k) for k, side in enumerate(sides)})
    for surface in box:
        centre = surface.pose[:3, 3] - [0.0, 0.0, 0.1]
        assert surface.pose[:3, 2] @ centre > 0.0
        assert np.abs(np.abs(surface.corners()) - [0.2, 0.15, 0.1]).max() < 0.11
    # Seen from the front, above and a little left: front, left and top.
    eye = np.array([2.0, 0.8, 1.2])
    forward = np.array([0.0, 0.0, 0.1]) - eye
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    camera_from_world = np.eye(4)
    camera_from_world[:3, :3] = [right, np.cross(forward, right), forward]
    camera_from_world[:3, 3] = -camera_from_world[:3, :3] @ eye
    light = render_light(pinhole, [[s.moved(camera_from_world) for s in box]], _dark(), fine=False)
    values, counts = np.unique(light[light > 0.0], return_counts=True)
    plainly = {round(float(x), 3) for x, n in zip(values, counts) if n > 30}
    assert plainly == {0.1, 0.3, 0.5}


def test_smooth_textures_are_interpolated(pinhole: Camera) -> None:
    values = np.tile(np.linspace(0.0, 1.0, 16, dtype=np.float32), (16, 1))
    surface = Surface(_facing(0.0, 0.0, 1.0), 0.5, 0.5, Texture(values, smooth=True))
    light = render_light(pinhole, [[surface]], _dark(), fine=False)
    left, right = pinhole.project(surface.corners())[[0, 1], 0]
    v = round(float(pinhole.project([0.0, 0.0, 1.0])[1]))
    u = np.arange(int(left) + 10, int(right) - 10)
    texel = (u - left) / (right - left) * 16.0 - 0.5
    np.testing.assert_allclose(light[v, u], texel / 15.0, atol=1e-4)


def test_exposures_are_averaged(pinhole: Camera) -> None:
    exposures = [[Surface(_facing(x, 0.0, 1.0), 0.2, 0.2, plain(1.0))] for x in (-0.02, 0.0, 0.02)]
    light = render_light(pinhole, exposures, _dark(), fine=False)
    each = [render_light(pinhole, [e], _dark(), fine=False) for e in exposures]
    assert np.abs(light - np.mean(each, axis=0)).max() < 0.05
    np.testing.assert_allclose(light.sum(), np.mean(each, axis=0).sum(), rtol=1e-3)


def test_bad_arguments_are_refused(pinhole: Camera) -> None:
    with pytest.raises(ValueError, match="background"):
        render_light(pinhole, [[]], np.zeros((10, 10), np.float32))
    with pytest.raises(ValueError, match="power of two"):
        render_light(pinhole, [[]], _dark(), samples=12)
    with pytest.raises(ValueError, match="not in rawseeds"):
        marker_texture(marker_dictionary("rawseeds"), 512)


@pytest.mark.parametrize("name", ["rawseeds", "artoolkitplus12", "artoolkitplus8", "4x4_50"])
def test_cells_are_where_the_dictionary_says(pinhole: Camera, name: str) -> None:
    dictionary = marker_dictionary(name)
    pose = _facing(0.0, 0.0, 1.0)
    card = marker_surface(dictionary, 31, 0.3, pose)
    light = render_light(pinhole, [[card]], _dark() + np.float32(0.5), fine=False)
    pattern = dictionary.patterns[31]
    for row, b in enumerate(dictionary.centres):
        for column, a in enumerate(dictionary.centres):
            point = pose[:3, :3] @ [0.3 * (a - 0.5), 0.3 * (0.5 - b), 0.0] + pose[:3, 3]
            u, v = np.rint(pinhole.project(point)).astype(int)
            printed = WHITE if pattern[row, column] else BLACK
            assert light[v, u] == pytest.approx(printed, abs=1e-6)
    # Round the cells the square is black, and round the square there is a white rim.
    for a, expected in ((0.5 * dictionary.cell, BLACK), (-0.5 * dictionary.cell, WHITE)):
        if name != "rawseeds" or a > 0.0:
            u, v = np.rint(pinhole.project(pose[:3, :3] @ [0.3 * (a - 0.5), 0.0, 0.0] + [0, 0, 1]))
            assert light[int(v), int(u)] == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize(
    ("name", "constant"),
    [
        ("4x4_50", "DICT_4X4_50"),
        ("6x6_250", "DICT_6X6_250"),
        ("apriltag_36h11", "DICT_APRILTAG_36h11"),
    ],
)
def test_opencv_finds_the_markers_where_the_truth_says(
    pinhole: Camera, name: str, constant: str
) -> None:
    rng = np.random.default_rng(8)
    number = getattr(cv2.aruco, constant)
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(number), parameters)
    errors = []
    for marker_id in (0, 7, 23):
        pose = random_pose(rng, pinhole, np.array([160.0, 120.0]), 90.0, 25.0, 0.2)
        card = marker_surface(marker_dictionary(name), marker_id, 0.2, pose)
        settings = Imaging(blur_px=0.7, noise_grey=1.0)
        light = render_light(pinhole, [[card]], _dark() + np.float32(0.4))
        image = grey_image(light, 1.0, settings, rng)
        found, ids, _ = detector.detectMarkers(image)
        assert ids is not None
        assert ids.ravel().tolist() == [marker_id]
        errors.append(found[0][0] - marker_corners(pinhole, pose, 0.2))
    assert np.abs(errors).max() < 0.5
    assert np.abs(np.mean(errors, axis=(0, 1))).max() < 0.1


def test_random_poses_have_the_width_and_slant_asked_for(camera: Camera) -> None:
    rng = np.random.default_rng(5)
    for width, slant in ((15.0, 0.0), (40.0, 35.0), (90.0, 70.0)):
        pixel = np.array([130.0, 100.0])
        pose = random_pose(rng, camera, pixel, width, slant, 0.2)
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
        assert np.linalg.det(pose[:3, :3]) > 0.0
        assert slant_deg(pose) == pytest.approx(slant, abs=1e-5)
        assert mean_side_px(marker_corners(camera, pose, 0.2)) == pytest.approx(width, rel=5e-3)
        np.testing.assert_allclose(camera.project(pose[:3, 3]), pixel, atol=1e-6)


def _shares(camera: Camera, surfaces: list[Surface]) -> tuple[float, float]:
    return visible_shares(camera, surfaces, 0, 0.2, surface_arrays(camera, surfaces))


def test_visible_share(pinhole: Camera) -> None:
    card = marker_surface(marker_dictionary("rawseeds"), 5, 0.2, _facing(0.0, 0.0, 1.0))
    assert _shares(pinhole, [card]) == (1.0, 1.0)
    half = Surface(_facing(0.25, 0.0, 0.999), 0.5, 0.5, plain(0.5), 0.5)
    visible, rim = _shares(pinhole, [card, half])
    assert visible == pytest.approx(0.5, abs=0.03)
    assert rim == pytest.approx(0.5, abs=0.03)
    # Half of it beyond the image's left border, and one that turns its back.
    x = float(pinhole.undistort([-0.5, 120.0])[0])
    cut = marker_surface(marker_dictionary("rawseeds"), 5, 0.2, _facing(x, 0.0, 1.0))
    assert _shares(pinhole, [cut])[0] == pytest.approx(0.5, abs=0.03)
    turned = pose_of([-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0])
    away = marker_surface(marker_dictionary("rawseeds"), 5, 0.2, turned)
    assert _shares(pinhole, [away]) == (0.0, 0.0)


def test_near_patterns_are_in_no_dictionary() -> None:
    rng = np.random.default_rng(1)
    for name in dictionary_names():
        dictionary = marker_dictionary(name)
        pattern = near_pattern(dictionary, rng)
        assert pattern.shape == dictionary.patterns.shape[1:]
        distance = pattern_distance(dictionary, pattern)
        assert distance > 0
        if len(dictionary) <= 512 and dictionary.patterns.any(axis=0).sum() >= 36:
            assert distance >= 3
    dictionary = marker_dictionary("rawseeds")
    assert pattern_distance(dictionary, np.rot90(dictionary.patterns[99], 3)) == 0


def test_uneven_light_is_a_factor_that_depends_on_its_seed() -> None:
    light = uneven_light(np.random.default_rng(2), 641, 479, 1.0, 3)
    again = uneven_light(np.random.default_rng(2), 641, 479, 1.0, 3)
    np.testing.assert_array_equal(light, again)
    assert light.shape == (479, 641)
    assert 0.0 < light.min() < 0.6
    assert light.max() <= 1.0


def test_noise_has_its_sigma_and_grey_values_are_rounded() -> None:
    light = np.full((200, 300), 0.5, np.float32)
    imaging = Imaging(blur_px=1.0, black_level=20.3, gain=100.0, noise_grey=3.0)
    image = grey_image(light, 1.0, imaging, np.random.default_rng(7)).astype(np.float64)
    assert image.mean() == pytest.approx(70.3, abs=0.06)
    assert image.std() == pytest.approx(np.hypot(3.0, np.sqrt(1.0 / 12.0)), rel=0.02)
    loud = Imaging(blur_px=1.0, black_level=0.0, gain=1000.0, noise_grey=0.0)
    assert np.all(grey_image(light, 1.0, loud, np.random.default_rng(7)) == 255)


def test_corners_are_a_markers() -> None:
    np.testing.assert_array_equal(
        square_corners(2.0), [[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]]
    )
