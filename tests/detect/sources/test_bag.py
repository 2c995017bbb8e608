"""Bags as ROS writes them: images of every encoding, times, odometry, and what is refused."""

from __future__ import annotations

import shutil
import sqlite3
import sys
from contextlib import closing
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip("rosbags", reason="the extra [bags] is not installed")

from camera import Camera, write_camera
from detect.cli import main
from detect.errors import DetectError, FrameError
from detect.options import SourceOptions
from detect.sources.bag import pixels_of_message
from detect.sources.grey_images import eight_bits, grey_of_pixels, read_image
from detect.sources.opening import open_source
from detect.sources.poses import TimedPose, step_between
from redetect.landmarks import Frame, Step, format_frame, read_frames, read_steps
from redetect.landmarks.frame_files import read_times
from redetect.plane import rotation
from tests.detect.commands import Captured, rows_in
from tests.pictures import read_grey
from tools.ros_bags import BAG_KINDS, BagKind, Ros, Said

PREFIXES = ["s.0000", "s.0001", "s.0002"]
START_S = 1_700_000_000.0
#: The covariance of a movement in (forward, left, turn), and how far it goes.
STEP_COVARIANCE = np.array([[2e-4, 1e-5, 2e-6], [1e-5, 5e-5, -3e-6], [2e-6, -3e-6, 4e-4]])


def poses_of_steps(steps: list[Step]) -> list[tuple[float, float, float]]:
    """Poses X forward, Y left: the first step leads to the origin, each other on from there."""
    x, y, theta = 0.0, 0.0, 0.0
    poses = [(x, y, theta)]
    for step in steps[1:]:
        forward, left = -step.dy, step.dx
        x += np.cos(theta) * forward - np.sin(theta) * left
        y += np.sin(theta) * forward + np.cos(theta) * left
        theta += step.dphi
        poses.append((x, y, theta))
    return poses


def recorded(ros: Ros, run: Path, compressed: bool = False) -> list[Said]:
    """The small run with its odometry, as a bag has them."""
    said = []
    for k, pose in enumerate(poses_of_steps(list(read_steps(run / "s.txt")))):
        time_s = START_S + 0.2 * k
        file = run / "images" / f"{PREFIXES[k]}.png"
        image = read_grey(file)
        if compressed:
            message = ros.compressed(file.read_bytes(), "mono8; png compressed", time_s)
        else:
            message = ros.image(image, "mono8", time_s, padding=5)
        said.append(Said("/front/image", time_s + 0.05, message))
        odometry = ros.odometry(*pose, time_s, np.diag([1e-4, 1e-4, 1e-6]) * k)
        said.append(Said("/odom", time_s + 0.01, odometry))
    return sorted(said, key=lambda item: item.time_s)


@pytest.fixture(scope="module")
def expected(small_run_template: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The discs in the small run's images, without odometry."""
    output = tmp_path_factory.mktemp("expected") / "expected.circles"
    camera = ["--camera", str(small_run_template / "s.cam"), "--odometry", "none"]
    images = str(small_run_template / "images")
    assert main(["circles", images, *camera, "-o", str(output)]) == 0
    return output


@pytest.mark.lowest
@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("kind", BAG_KINDS)
def test_a_bag_gives_the_rows_of_its_images(
    small_run: Path, expected: Path, tmp_path: Path, kind: BagKind, compressed: bool
) -> None:
    ros, found = Ros(kind), tmp_path / "found.circles"
    (tmp_path / "bag").mkdir()
    path = ros.write(tmp_path / "bag" / "s", recorded(ros, small_run, compressed))
    camera = ["--camera", str(small_run / "s.cam")]
    assert main(["circles", str(path), *camera, "-o", str(found)]) == 0
    landmarks = [row for row in rows_in(expected) if row.startswith("LANDMARK_C")]
    assert [row for row in rows_in(found) if row.startswith("LANDMARK_C")] == landmarks
    steps = [frame.step for frame in read_frames(found)]
    assert steps[0].dx == steps[0].dy == steps[0].cxx == 0.0  # before the first there is nothing
    for step, wanted in zip(steps[1:], list(read_steps(small_run / "s.txt"))[1:], strict=True):
        assert (step.dx, step.dy, step.dphi) == pytest.approx(
            (wanted.dx, wanted.dy, wanted.dphi), abs=1.1e-5
        )
        assert step.cxx > 0.0
    times = read_times(f"{found}.times")
    assert list(times) == PREFIXES
    assert list(times.values()) == pytest.approx([START_S, START_S + 0.2, START_S + 0.4], abs=1e-5)
    # Without odometry, the whole file is that of the folder without.
    arguments = ["circles", str(path), *camera, "-o", str(found), "--odometry", "none"]
    assert main([*arguments, "--force"]) == 0
    assert found.read_bytes() == expected.read_bytes()


def test_steps_and_covariances_of_odometry_come_back(tmp_path: Path) -> None:
    """A drive of known steps, whose covariance has grown as odometry's does."""
    rng = np.random.default_rng(4)
    ros = Ros()
    grey = np.zeros((4, 6), np.uint8)
    pose, covariance = np.array([3.0, -2.0, 1.0]), 1e-3 * np.diag([1.0, 2.0, 3.0])
    said, moves = [], []
    for k in range(12):
        if k:
            move = rng.normal(0.0, [0.4, 0.1, 0.6])
            moves.append(move)
            cos, sin = np.cos(pose[2]), np.sin(pose[2])
            turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
            shift = turn @ move
            carry = np.eye(3)
            carry[:2, 2] = (-shift[1], shift[0])
            covariance = carry @ covariance @ carry.T + turn @ STEP_COVARIANCE @ turn.T
            pose = pose + shift
        time_s = 10.0 + k
        said.append(
            Said("/odom", time_s, ros.odometry(pose[0], pose[1], pose[2], time_s, covariance))
        )
        said.append(Said("/image", time_s, ros.image(grey, "mono8", time_s)))
    frames = list(open_source(ros.write(tmp_path / "drive", said)).frames)
    assert len(frames) == 12
    c = STEP_COVARIANCE
    for frame, (forward, left, phi) in zip(frames[1:], moves, strict=True):
        s = frame.step
        assert (s.dx, s.dy, s.dphi) == pytest.approx((left, -forward, phi), abs=1e-5)
        # X left, Y backward: cov(X, Y) = -cov(left, forward), and so on.
        expected = (c[1, 1], -c[0, 1], c[0, 0], c[1, 2], -c[0, 2], c[2, 2])
        assert (s.cxx, s.cxy, s.cyy, s.cxphi, s.cyphi, s.cphiphi) == pytest.approx(
            expected, abs=1e-9
        )


def blank(ros: Ros, time_s: float) -> Said:
    """An image that nothing is looked for in."""
    return Said("/i", time_s, ros.image(np.zeros((4, 4), np.uint8), "mono8", time_s))


def test_covariances_that_do_not_grow_are_none(tmp_path: Path) -> None:
    """Drivers that always publish the same covariance say nothing of a step's."""
    ros = Ros()
    said = []
    for k in range(3):
        odometry = ros.odometry(0.3 * k, 0.0, 0.0, 1.0 + k, np.diag([0.1, 0.1, 0.2]))
        said.append(Said("/odom", 1.0 + k, odometry))
        said.append(blank(ros, 1.0 + k))
    steps = [frame.step for frame in open_source(ros.write(tmp_path / "d", said)).frames]
    assert [step.dy for step in steps] == pytest.approx([0.0, -0.3, -0.3])
    assert all(step.cxx == step.cyy == step.cphiphi == 0.0 for step in steps)


def test_variances_that_are_added_up(tmp_path: Path) -> None:
    """Some drivers add up variances, and ignore how errors of the heading move positions."""
    ros, said = Ros(), []
    for k in range(3):
        variances = np.diag([0.1, 0.1, 0.2]) + k * np.diag([2e-4, 2e-4, 1e-4])
        odometry = ros.odometry(0.3 * k, 0.0, 0.0, 1.0 + k, variances)
        said.append(Said("/odom", 1.0 + k, odometry))
        said.append(blank(ros, 1.0 + k))
    for frame in list(open_source(ros.write(tmp_path / "d", said)).frames)[1:]:
        step = frame.step
        assert (step.cxx, step.cyy, step.cphiphi) == pytest.approx((2e-4, 2e-4, 1e-4))


def test_a_step_is_unknown_if_a_part_of_it_is(tmp_path: Path) -> None:
    ros, said = Ros(), []
    for k, variance in enumerate((0.1, 0.2, 0.15, 0.25, 0.3, 0.35, 0.4)):
        odometry = ros.odometry(0.3 * k, 0.0, 0.0, 1.0 + k, variance * np.eye(3))
        said.append(Said("/odom", 1.0 + k, odometry))
        if k % 3 == 0:
            said.append(blank(ros, 1.0 + k))
    steps = [frame.step for frame in open_source(ros.write(tmp_path / "d", said)).frames]
    assert [step.cphiphi for step in steps] == pytest.approx([0.0, 0.0, 0.15])


def test_steps_of_a_filter_that_corrects_its_heading(tmp_path: Path) -> None:
    """Monte Carlo: white noise of odometry, and a compass that is read at every fifth message."""
    rng, ros, said = np.random.default_rng(7), Ros(), []
    sigmas, compass = np.array([4e-3, 2e-3, 8e-3]), 0.03
    truth, found, covariance = np.zeros(3), np.zeros(3), np.zeros((3, 3))
    truths = []
    for k in range(1500):
        move = np.array([0.02, 0.0, 0.01 * np.sin(0.01 * k)])
        ends = []
        for pose, moved in ((truth, move), (found, move + sigmas * rng.normal(size=3))):
            along = np.eye(3)
            along[:2, :2] = rotation(pose[2])
            shift = along @ moved
            ends.append(pose + shift)
        truth, found = ends
        carry = np.eye(3)
        carry[:2, 2] = -shift[1], shift[0]
        covariance = carry @ covariance @ carry.T + along @ np.diag(sigmas**2) @ along.T
        if k % 5 == 4:
            gain = covariance[:, 2] / (covariance[2, 2] + compass**2)
            found = found + gain * (truth[2] + compass * rng.normal() - found[2])
            covariance = covariance - np.outer(gain, covariance[2])
        time_s, (x, y, theta) = 1.0 + 0.1 * k, found.tolist()
        said.append(Said("/odom", time_s, ros.odometry(x, y, theta, time_s, covariance)))
        if k % 8 == 0:
            said.append(blank(ros, time_s))
            truths.append(TimedPose(time_s, truth[0], truth[1], truth[2]))
    steps = [frame.step for frame in open_source(ros.write(tmp_path / "d", said)).frames]
    errors = []
    for s, (before, after) in zip(steps[1:], pairwise(truths), strict=True):
        true = step_between("e", before, after)
        error = np.array([s.dx - true.dx, s.dy - true.dy, s.dphi - true.dphi])
        c = [[s.cxx, s.cxy, s.cxphi], [s.cxy, s.cyy, s.cyphi], [s.cxphi, s.cyphi, s.cphiphi]]
        errors.append(error @ np.linalg.solve(c, error) / 3.0)
    assert np.mean(errors) == pytest.approx(1.0, abs=0.15)


def test_covariances_of_twists_where_those_of_poses_do_not_grow(tmp_path: Path) -> None:
    """Of ten independent movements over 0.1 s, the variances add up; unless one is singular."""
    twist = np.diag([0.04, 0.01, 0.0025])
    for name, stated in (("full", twist), ("no_turn", np.diag([0.04, 0.01, 0.0]))):
        ros = Ros()
        said = []
        for k in range(31):
            time_s = 1.0 + 0.1 * k
            message = ros.odometry(0.02 * k, 0.0, 1.0, time_s, 0.1 * np.eye(3), stated)
            said.append(Said("/odom", time_s, message))
            if k % 10 == 0:
                said.append(blank(ros, time_s))
        steps = [frame.step for frame in open_source(ros.write(tmp_path / name, said)).frames]
        variances = np.array([[s.cxx, s.cyy, s.cphiphi] for s in steps[1:]])
        expected = [1e-3, 4e-3, 2.5e-4] if name == "full" else [0.0, 0.0, 0.0]
        np.testing.assert_allclose(variances, np.tile(expected, (3, 1)), atol=1e-5)


def test_images_between_poses_and_beyond_them(tmp_path: Path) -> None:
    """Poses at 1.0, 1.4, 1.8 and 5 s: what lies between the last two is not made up."""
    ros = Ros()
    said = [
        Said("/odom", time_s, ros.odometry(x, 0.0, theta, time_s, np.zeros((3, 3))))
        for time_s, x, theta in ((1.0, 0.0, 3.1), (1.4, 0.4, -3.1), (1.8, 0.8, -3.1), (5.0, 1, 0))
    ]
    said += [blank(ros, time_s) for time_s in (0.5, 1.0, 1.2, 1.5, 3.0, 5.0, 5.5)]
    run = open_source(ros.write(tmp_path / "d", sorted(said, key=lambda s: s.time_s)))
    frames = list(run.frames)
    assert [frame.time_s for frame in frames] == pytest.approx([1.0, 1.2, 1.5, 5.0])
    assert run.frames.left_out == 3
    assert "pose of" in run.frames.why_left_out
    half_turn = np.pi - 3.1
    assert frames[1].step.dphi == pytest.approx(half_turn, abs=1e-5)  # the shorter way round
    assert frames[1].step.dy == pytest.approx(-0.2 * np.cos(3.1), abs=1e-5)


def test_odometry_that_is_reset_is_lost_there(tmp_path: Path) -> None:
    ros, said = Ros(), []
    for k in range(100):
        x = 0.01 * k + 3.0 if k < 55 else 0.01 * k
        moved = ros.odometry(x, 0.0, 0.0, 1.0 + 0.02 * k, np.zeros((3, 3)))
        said.append(Said("/odom", 1.0 + 0.02 * k, moved))
    said += [blank(ros, time_s) for time_s in np.arange(1.0, 2.9, 0.2).tolist()]
    run = open_source(ros.write(tmp_path / "d", sorted(said, key=lambda s: s.time_s)))
    steps = [frame.step for frame in run.frames]
    lost = [k for k, step in enumerate(steps) if step.cxx > 1e5]
    assert lost == [6]
    assert [step.dy for k, step in enumerate(steps[1:], 1) if k != 6] == pytest.approx([-0.1] * 8)


# -- encodings ------------------------------------------------------------------------------

COLOURS = np.random.default_rng(8).integers(0, 256, (6, 8, 3)).astype(np.uint8)  # B, G, R
GRAY = COLOURS[:, :, 0]
LUMA = cv2.cvtColor(COLOURS, cv2.COLOR_BGR2GRAY)
OPAQUE = np.concatenate([COLOURS, np.full((6, 8, 1), 255, np.uint8)], axis=2)


@pytest.mark.parametrize(
    ("encoding", "pixels", "expected"),
    [
        ("mono8", GRAY, GRAY),
        ("8UC1", GRAY, GRAY),
        ("bgr8", COLOURS, LUMA),
        ("rgb8", COLOURS[:, :, ::-1], LUMA),
        ("bgra8", OPAQUE, LUMA),
        ("rgba8", OPAQUE[:, :, [2, 1, 0, 3]], LUMA),
        ("mono16", GRAY.astype("<u2") << 8, GRAY),
        ("mono16", GRAY.astype(">u2") << 8, GRAY),
        ("16UC1", GRAY.astype("<u2") << 4, GRAY),
        ("rgb16", COLOURS[:, :, ::-1].astype("<u2") << 8, LUMA),
        ("yuv422", np.stack([255 - GRAY, GRAY], axis=2), GRAY),
        ("yuv422_yuy2", np.stack([GRAY, 255 - GRAY], axis=2), GRAY),
    ],
)
@pytest.mark.parametrize("padding", [0, 3])
def test_encodings(
    encoding: str, pixels: NDArray[Any], expected: NDArray[np.uint8], padding: int
) -> None:
    if padding and pixels.dtype.itemsize == 2:
        padding = 4
    message = Ros().image(pixels, encoding, 1.0, padding=padding)
    found = pixels_of_message(message, "image")
    grey = eight_bits(grey_of_pixels(found, "image"), "image")
    assert grey.dtype == np.uint8
    assert np.abs(grey.astype(int) - expected).max() <= (1 if encoding == "rgb16" else 0)


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
@pytest.mark.parametrize("deep", [False, True])
def test_bayer_patterns(pattern: str, deep: bool) -> None:
    """Of one colour all over, each pixel sees its own part; the brightness is the colour's."""
    colour = {"r": 200, "g": 100, "b": 50}
    cell = np.array([colour[name] for name in pattern]).reshape(2, 2)
    mosaic = np.tile(cell, (8, 8)).astype("<u2" if deep else "u1")
    if deep:
        mosaic <<= 8
    message = Ros().image(mosaic, f"bayer_{pattern}{16 if deep else 8}", 1.0)
    grey = eight_bits(grey_of_pixels(pixels_of_message(message, "image"), "image"), "image")
    expected = 0.299 * 200 + 0.587 * 100 + 0.114 * 50
    assert np.abs(grey[2:-2, 2:-2] - expected).max() <= 1.0


@pytest.mark.parametrize("encoding", ["32FC1", "nv21", "bayer_xyzw8", "", "mono"])
def test_other_encodings_cost_their_frame(encoding: str) -> None:
    with pytest.raises(FrameError, match="expected mono, bgr, rgb"):
        pixels_of_message(Ros().image(GRAY, encoding, 1.0), "image")


def test_a_message_with_too_little_data() -> None:
    message = Ros().image(GRAY, "mono8", 1.0)
    message.data = message.data[:-1]
    with pytest.raises(FrameError, match="47 bytes for 8x6 px of mono8"):
        pixels_of_message(message, "image")


def test_a_bad_image_costs_its_frame(tmp_path: Path) -> None:
    ros = Ros()
    good, bad = ros.image(GRAY, "mono8", 1.0), ros.image(GRAY, "32FC1", 2.0)
    path = ros.write(tmp_path / "d", [Said("/i", 1.0, good), Said("/i", 2.0, bad)])
    first, second = open_source(path).frames
    np.testing.assert_array_equal(read_image(first, None), GRAY)
    with pytest.raises(FrameError, match=r"d\.mcap: d\.0001: encoding '32FC1'"):
        read_image(second, None)


@pytest.mark.parametrize("kind", BAG_KINDS)
def test_images_may_be_written_to(tmp_path: Path, kind: BagKind) -> None:
    """As those of files may: for others every kernel would be compiled once more."""
    ros = Ros(kind)
    path = ros.write(tmp_path / "d", [Said("/i", 1.0, ros.image(GRAY, "mono8", 1.0))])
    (frame,) = open_source(path).frames
    image = read_image(frame, None)
    np.testing.assert_array_equal(image, GRAY)
    assert image.flags.writeable
    assert image.flags.c_contiguous


def test_times_of_recording_where_the_header_has_none(tmp_path: Path) -> None:
    ros = Ros()
    said = [Said("/i", 7.5 + k, ros.image(GRAY, "mono8", 0.0)) for k in range(2)]
    frames = open_source(ros.write(tmp_path / "d", said)).frames
    assert [frame.time_s for frame in frames] == [7.5, 8.5]


# -- choosing topics, refusals ---------------------------------------------------------------


def test_several_topics_have_to_be_named(tmp_path: Path) -> None:
    ros = Ros()
    said = [
        Said("/left", 1.0, ros.image(GRAY, "mono8", 1.0)),
        Said("/right", 1.0, ros.image(GRAY // 2, "mono8", 1.0)),
        Said("/odom", 1.0, ros.odometry(0, 0, 0, 1.0, np.zeros((3, 3)))),
        Said("/visual", 1.0, ros.odometry(0, 0, 0, 1.0, np.zeros((3, 3)))),
    ]
    path = ros.write(tmp_path / "d", said)
    with pytest.raises(DetectError, match=r"images \(/left, /right\): name one by --image-topic"):
        open_source(path)
    with pytest.raises(DetectError, match=r"odometry \(/odom, /visual\): name one by --odometry"):
        open_source(path, None, SourceOptions(image_topic="/right"))
    with pytest.raises(DetectError, match="no images in '/odom'"):
        open_source(path, None, SourceOptions(image_topic="/odom"))
    with pytest.raises(DetectError, match="no odometry in '/left'"):
        open_source(path, None, SourceOptions(image_topic="/left", odometry="/left"))
    run = open_source(path, None, SourceOptions(image_topic="/right", odometry="/odom"))
    (frame,) = run.frames
    np.testing.assert_array_equal(read_image(frame, None), GRAY // 2)
    assert run.odometry == path


def test_a_bag_without_images(tmp_path: Path) -> None:
    ros = Ros()
    said = [Said("/odom", 1.0, ros.odometry(0, 0, 0, 1.0, np.zeros((3, 3))))]
    with pytest.raises(DetectError, match="no images in it, but nav_msgs/msg/Odometry: expected"):
        open_source(ros.write(tmp_path / "d", said))


def test_poses_have_to_be_in_order_and_finite(tmp_path: Path) -> None:
    ros = Ros()
    images = [blank(ros, time_s) for time_s in (1.0, 2.0, 3.0, 4.0)]
    for name, stamps, x, told in (
        ("back", (1.0, 3.0, 2.0), 0.0, "comes after that of 3.000000 s: expected times in order"),
        ("nan", (1.0, 2.0, 3.0), float("nan"), "expected a finite pose"),
    ):
        poses = [
            Said("/odom", 1.0 + k, ros.odometry(x, 0, 0, t, np.zeros((3, 3))))
            for k, t in enumerate(stamps)
        ]
        path = ros.write(tmp_path / name, sorted([*poses, *images], key=lambda s: s.time_s))
        with pytest.raises(DetectError, match=told):
            list(open_source(path).frames)


@pytest.mark.parametrize("kind", BAG_KINDS)
@pytest.mark.parametrize("share", [0.0, 0.02, 0.5, 0.95])
def test_damaged_bags_are_told_in_one_line(
    small_run: Path, tmp_path: Path, kind: BagKind, share: float, capsys: Captured
) -> None:
    ros = Ros(kind)
    path = ros.write(tmp_path / "d", recorded(ros, small_run))
    file = path if path.is_file() else next(p for p in path.iterdir() if p.suffix != ".yaml")
    content = file.read_bytes()
    file.write_bytes(content[: int(share * len(content))])
    code = main(["circles", str(path), "--camera", str(small_run / "s.cam")])
    told = capsys.readouterr().err.splitlines()
    if code == 0:
        return  # what is there can be read: MCAP files are searched for what they still hold
    assert code == 1
    (line,) = told
    assert line.startswith(f"error: {path}: ")
    assert "expected" in line


@pytest.mark.parametrize(
    "damage",
    [
        "UPDATE topics SET type_description_hash = ?",  # shown by the package that reads bags
        "UPDATE topics SET name = ? || id",
        "UPDATE topics SET type = ?",
    ],
)
def test_what_a_bag_says_is_shown_in_part_however_it_is_written(
    small_run: Path, tmp_path: Path, damage: str
) -> None:
    ros = Ros("sqlite")
    bag = ros.write(tmp_path / "d", recorded(ros, small_run))
    (file,) = bag.glob("*.db3")
    with closing(sqlite3.connect(file)) as database:
        database.execute(damage, ("\x01\U000e0001" * 100,))
        database.commit()
    (bag / "metadata.yaml").unlink()  # it says the same
    try:
        list(open_source(file).frames)
    except DetectError as error:
        said = str(error).replace(str(file), "")
        assert said.isprintable()
        assert len(said) < 500


def test_without_the_package(
    small_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Captured
) -> None:
    ros = Ros()
    path = ros.write(tmp_path / "bag", recorded(ros, small_run))
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    assert main(["circles", str(path), "--camera", str(small_run / "s.cam")]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "pip install 'redetect[bags]'" in line


def test_a_calibration_beside_the_bag(small_run: Path, tmp_path: Path) -> None:
    ros = Ros()
    path = ros.write(tmp_path / "s_bag", recorded(ros, small_run))
    shutil.copy(small_run / "s.cam", tmp_path / "front.cam")
    assert main(["markers", str(path)]) == 0
    (head,) = [
        row
        for row in (tmp_path / "s_bag.detected.markers").read_text().splitlines()
        if row.startswith("# camera ")
    ]
    assert "none" not in head
    expected = b"".join(
        format_frame(Frame(frame.step)) for frame in open_source(path).frames
    ).decode()
    assert rows_in(tmp_path / "s_bag.detected.markers") == expected.splitlines()


@pytest.mark.parametrize(
    ("definition", "fields"),
    [("string data\nint32 height\n", ("abc", 3)), ("int8 header\nint8 data\n", (1, 1))],
)
def test_a_bag_that_defines_images_in_its_own_way(
    published_camera: Camera,
    tmp_path: Path,
    capsys: Captured,
    definition: str,
    fields: tuple[Any, ...],
) -> None:
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import get_types_from_msg
    from rosbags.typesys.store import Typestore

    kind = "sensor_msgs/msg/Image"
    store = Typestore()
    store.register(get_types_from_msg(definition, kind))
    bag, cam = tmp_path / "own.bag", tmp_path / "own.cam"
    with Writer(bag) as writer:
        connection = writer.add_connection("/i", kind, typestore=store)
        writer.write(connection, 10**9, store.serialize_ros1(store.types[kind](*fields), kind))
    write_camera(published_camera, cam)
    assert main(["circles", str(bag), "--camera", str(cam)]) == 1
    *_, line = capsys.readouterr().err.splitlines()  # a table may have been told of before
    assert line.startswith(f"error: {bag}: own.0000: a message differs from ROS's type: ")
