"""The flags of the command ``camera``: one frozen dataclass per command, nothing heavy imported."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from camera.errors import ConversionError
from redetect.bounds import Bounded, LimitOr0, MaybePath

BoardKind = Literal["checkerboard", "charuco", "circles", "asymmetric-circles"]
Format = Literal["cam", "opencv", "ros", "kalibr", "colmap"]


@dataclass(frozen=True, kw_only=True)
class BoardFlags:
    """A printed board."""

    output: Annotated[Path, arg(aliases=["-o"])]  #: The .cam file to write.
    #: Checkerboard: inner corners in a row. ChArUco: squares in a row. Circles: circles in a row.
    columns: int
    rows: int  #: The same for a column.
    square_m: float  #: Side of a square, or distance between rows of circles (m).
    #: `checkerboard`, `charuco`, `circles` (in rows and columns) or `asymmetric-circles` (every
    #: other row shifted by half the spacing).
    board: BoardKind = "checkerboard"
    marker_m: float = 0.0  #: Side of a ChArUco board's markers (m).
    dictionary: str = "DICT_5X5_100"  #: OpenCV's dictionary of a ChArUco board.
    #: Diameter of the circles (m), used to correct the perspective shift of their centres.
    circle_m: float = 0.0
    force: bool = False  #: Replace existing files.


@dataclass(frozen=True, kw_only=True)
class Calibrate(BoardFlags):
    """Calibrate a camera from photographs or a video of a board.

    Example: camera calibrate photographs --columns 9 --rows 6 --square-m 0.025 -o my.cam

    Parameters
    ----------
    output : Path
        The .cam file. Beside it, a .json report on inputs and residuals, and pictures of residuals
        and coverage.
    """

    images: Positional[tuple[Path, ...]]  #: Photographs, folders of them, or a video.
    #: Pictures are half-height: every second line of square pixels, as in the data set.
    half: bool = False
    #: Estimate horizontal and vertical scale independently, if the pictures determine their ratio.
    #: --no-free-aspect: pixels are square (with --half, twice as high as wide).
    free_aspect: bool = True
    #: Number of free radial distortion coefficients, 0 to 5; `auto`: as many as reduce the error in
    #: held-out pictures.
    coefficients: Literal["auto", "0", "1", "2", "3", "4", "5"] = "auto"
    #: Whether the tangential terms p1 and p2 of a decentred lens are free: `on`, `off`, or `auto`:
    #: if they reduce that error and are significant.
    tangential: Literal["auto", "on", "off"] = "auto"
    #: Whether the radial distortion is OpenCV's polynomial k1 k2 k3 instead of the rational
    #: function: `on` (then --coefficients are 0 to 3), `off`, or `auto`: if it needs fewer
    #: coefficients for the same error in held-out pictures, or has a much smaller one.
    polynomial: Literal["auto", "on", "off"] = "auto"
    #: Keep pictures whose residuals are far above the others'.
    keep_outliers: bool = False
    #: Use at most this many pictures, and at most this many frames per video, evenly spaced.
    max_images: int = 60
    #: Folder for check pictures: the corners found and projected in each photograph.
    pictures: MaybePath = None


@dataclass(frozen=True, kw_only=True)
class Board(BoardFlags):
    """Print a calibration board, or discs, as a PDF at true scale.

    Example: camera board --columns 9 --rows 6 --square-m 0.025 -o board.pdf

    Example: camera board --board discs --circle-m 0.2 -o disc.pdf

    Parameters
    ----------
    board : str
        As in `camera calibrate`, or `discs`: landmarks for the floor.
    circle_m : float
        Diameter of the circles or discs (m).
    output : Path
        The PDF to write.
    """

    board: BoardKind | Literal["discs"] = "checkerboard"  # type: ignore[assignment]
    columns: int = 1  #: As in `camera calibrate`; for discs, the number in a row.
    rows: int = 1  #: The same for a column.
    square_m: float = 0.025  #: Side of a square, or distance between rows of circles (m).


@dataclass(frozen=True, kw_only=True)
class Floor(BoardFlags):
    """Estimate the pose of a calibrated camera from a board or known points on the floor.

    Example: camera floor my.cam floor.jpg --columns 9 --rows 6 --square-m 0.025
    --floor-origin 0 -1.5 --floor-yaw 180 -o placed.cam

    Example: camera floor my.cam places.csv -o placed.cam
    """

    camera: Positional[Path]  #: The .cam file; its pose is ignored.
    #: A picture of the board lying on the floor, or a .csv of floor points with the columns u,v,x,y
    #: (pixels; metres, X left and Y backward of the robot).
    floor: Positional[Path]
    #: Checkerboard: inner corners in a row. ChArUco: squares in a row. Circles: circles in a row.
    columns: int = 0
    rows: int = 0  #: The same for a column.
    square_m: float = 0.0  #: Side of a square, or distance between rows of circles (m).
    #: Middle of that board's points: X (left) and Y (backward) of the robot, m.
    floor_origin: tuple[float, float] = (0.0, 0.0)
    #: Rotation of that board (degrees): from the robot's X axis (left) to the board's x axis,
    #: counterclockwise seen from above. 0: a checkerboard's black corner square is at the back
    #: right, 180: at the front left. With 180 the board appears upright in the image.
    floor_yaw: float = 0.0
    #: Folder for check pictures: the floor's grid and the horizon in the photograph, and the floor
    #: from above.
    pictures: MaybePath = None


@dataclass(frozen=True)
class Convert(Bounded, error=ConversionError):
    """Convert a calibration from or to another program's format.

    Example: camera convert images/e/e.cam e.opencv.yaml

    Example: camera convert camchain.yaml my.cam --rows halve

    If the target model contains the source's, its numbers are copied; otherwise it is fitted to the
    source's pixels over the whole image. The largest deviation is printed, and above --limit-px
    nothing is written.
    """

    source: Positional[Path]  #: The calibration to convert; its content determines the format.
    #: The file to write; its name determines the format: .cam; cameras.txt; .opencv.yaml, .ros.yaml
    #: or .kalibr.yaml, and camera_info.yaml, camchain.yaml.
    target: Positional[Path]
    #: Distortion model of the target: `radtan` (k1 k2 p1 p2, with OpenCV and ROS also k3),
    #: `rational` (k1 to k6), `fisheye` (equidistant); `auto`: the first of them that is within the
    #: limit.
    model: Literal["auto", "radtan", "rational", "fisheye"] = "auto"
    #: Lines of the image: `same`; `halve`: the source is for full frames, the target for their even
    #: lines (`half`); `double`: the other way (`nohalf`).
    rows: Literal["same", "halve", "double"] = "same"
    limit_px: LimitOr0 = 0.05  #: Largest accepted deviation, pixels.
    #: The camera in a file with several, such as cam0 (Kalibr) or its number (COLMAP).
    camera_name: str = ""
    #: A .cam file whose pose is copied to the target .cam file; other formats have no pose, and
    #: without this it is the identity, until `camera floor` estimates it.
    pose_from: MaybePath = None
    force: bool = False  #: Replace an existing file.


@dataclass(frozen=True)
class Level:
    """Estimate a camera's mounting from a drive: its constant lean, and its height above the floor.

    The lean is estimated from the building's verticals, the height from discs of known size. The
    lens is assumed to be calibrated correctly.

    Example: camera level images/e -o level.cam
    """

    run: Positional[Path]  #: Images of the drive, as for `detect all`.
    output: Annotated[Path, arg(aliases=["-o"])]  #: The .cam file to write.
    camera: MaybePath = None  #: The calibration, if not the one beside the images.
    radius_m: float = 0.10  #: Radius of the discs.
    force: bool = False  #: Replace an existing file.
