"""The flags of the command ``camera``: one frozen dataclass per command, nothing heavy imported."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from redetect.storage.bounds import MaybePath

BoardKind = Literal["checkerboard", "charuco", "circles", "asymmetric-circles"]
Format = Literal["cam", "opencv", "ros", "kalibr", "colmap"]


@dataclass(frozen=True, kw_only=True)
class BoardFlags:
    """A printed board."""

    output: Annotated[Path, arg(aliases=["-o"])]  #: The .cam file to write.
    #: Checkerboard: inner corners in a row. ChArUco: squares in a row. Circles: circles in a row.
    columns: int
    rows: int  #: Likewise, of a column.
    square_m: float  #: Side of a square, or the distance of rows of circles (m).
    #: `checkerboard`, `charuco`, `circles` (in rows and columns) or `asymmetric-circles` (every
    #: other row moved by half a distance).
    board: BoardKind = "checkerboard"
    marker_m: float = 0.0  #: Side of a ChArUco board's markers (m).
    dictionary: str = "DICT_5X5_100"  #: Of a ChArUco board, as OpenCV names it.
    #: Diameter of the circles (m); with it, perspective no longer shifts their middles.
    circle_m: float = 0.0
    force: bool = False  #: Replace existing files.


@dataclass(frozen=True, kw_only=True)
class Calibrate(BoardFlags):
    """Calibrate a camera from photographs or a video of a board.

    Example: camera calibrate photographs --columns 9 --rows 6 --square-m 0.025 -o my.cam

    Parameters
    ----------
    output : Path
        The .cam file. Beside it: .json with what it was made from and how well that fits, and
        pictures of residuals and coverage.
    """

    images: Positional[tuple[Path, ...]]  #: Photographs, folders of them, or a video.
    #: Pictures are half-height: every second line of square pixels, as the data set's.
    half: bool = False
    #: Horizontal and vertical scale are independent of each other, unless the pictures leave their
    #: ratio open. --no-free-aspect: pixels are square (with --half, twice as high as wide).
    free_aspect: bool = True
    #: Number of free radial distortion coefficients, 0 to 5; `auto`: as many as make the error in
    #: pictures that were held out smaller.
    coefficients: Literal["auto", "0", "1", "2", "3", "4", "5"] = "auto"
    #: Whether the tangential terms p1 and p2 of a decentred lens are free: `on`, `off`, or `auto`:
    #: if they make that error smaller and are more than noise.
    tangential: Literal["auto", "on", "off"] = "auto"
    #: Whether the radial distortion is OpenCV's polynomial k1 k2 k3 instead of the rational
    #: function: `on` (then --coefficients are 0 to 3), `off`, or `auto`: if fewer coefficients do
    #: as well then in pictures that were held out, or their error is much smaller.
    polynomial: Literal["auto", "on", "off"] = "auto"
    #: Keep pictures whose residuals are far above the others'.
    keep_outliers: bool = False
    #: Use at most this many pictures, and at most this many frames per video, evenly spaced.
    max_images: int = 60
    #: Folder for pictures to check by: the corners found and projected in each photograph.
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
    columns: int = 1  #: As in `camera calibrate`; of discs, how many side by side.
    rows: int = 1  #: Likewise, of a column.
    square_m: float = 0.025  #: Side of a square, or the distance of rows of circles (m).


@dataclass(frozen=True, kw_only=True)
class Floor(BoardFlags):
    """Give a calibrated camera its pose, from a board or known places on the floor.

    Example: camera floor my.cam floor.jpg --columns 9 --rows 6 --square-m 0.025
    --floor-origin 0 -1.5 --floor-yaw 180 -o placed.cam

    Example: camera floor my.cam places.csv -o placed.cam
    """

    camera: Positional[Path]  #: The .cam file; its pose does not matter.
    #: A picture of the board lying on the floor, or a .csv with the columns u,v,x,y of places on
    #: it (pixels; metres, X left and Y backward of the robot).
    floor: Positional[Path]
    #: Checkerboard: inner corners in a row. ChArUco: squares in a row. Circles: circles in a row.
    columns: int = 0
    rows: int = 0  #: Likewise, of a column.
    square_m: float = 0.0  #: Side of a square, or the distance of rows of circles (m).
    #: Where the middle of that board's points lies: X (left) and Y (backward) of the robot, m.
    floor_origin: tuple[float, float] = (0.0, 0.0)
    #: By how much that board is turned (degrees): from the robot's X axis (left) to the board's x
    #: axis, counterclockwise seen from above. 0: a checkerboard's black corner square is at the
    #: back right, 180: at the front left. With 180 the board appears upright in the image.
    floor_yaw: float = 0.0
    #: Folder for pictures to check by: the floor's grid and the horizon in the photograph, and the
    #: floor from above.
    pictures: MaybePath = None


@dataclass(frozen=True)
class Convert:
    """Convert a calibration from or to another program's format.

    Example: camera convert images/e/e.cam e.opencv.yaml

    Example: camera convert camchain.yaml my.cam --rows halve

    Where the target model contains the source's, its numbers are taken over; else it is fitted to
    the source's pixels over the whole image. The largest deviation is printed, and above
    --limit-px nothing is written.
    """

    source: Positional[Path]  #: The calibration to convert; its content says the format.
    #: The file to write; its name says the format: .cam; cameras.txt; .opencv.yaml, .ros.yaml or
    #: .kalibr.yaml, and camera_info.yaml, camchain.yaml.
    target: Positional[Path]
    #: Distortion model of the target: `radtan` (k1 k2 p1 p2, with OpenCV and ROS also k3),
    #: `rational` (k1 to k6), `fisheye` (equidistant); `auto`: the first of them that is within the
    #: limit.
    model: Literal["auto", "radtan", "rational", "fisheye"] = "auto"
    #: Lines of the image: `same`; `halve`: the source is for full frames, the target for their even
    #: lines (`half`); `double`: the other way (`nohalf`).
    rows: Literal["same", "halve", "double"] = "same"
    limit_px: float = 0.05  #: Largest deviation that is accepted, pixels.
    #: Which camera of a file that holds several, such as cam0 (Kalibr) or its number (COLMAP).
    camera_name: str = ""
    #: A .cam file whose pose the .cam file gets; other formats have none, and without this it is
    #: the identity, until `camera floor` finds it.
    pose_from: MaybePath = None
    force: bool = False  #: Replace an existing file.


@dataclass(frozen=True)
class Level:
    """Find how a camera is mounted by a drive: its constant lean, and its height over the floor.

    The lean is that of the building's verticals; the height follows from discs of known size. The
    lens is taken as calibrated.

    Example: camera level images/e -o level.cam
    """

    run: Positional[Path]  #: Images of the drive: what `detect all` takes.
    output: Annotated[Path, arg(aliases=["-o"])]  #: The .cam file to write.
    camera: MaybePath = None  #: The calibration, if it is not the one beside the images.
    radius_m: float = 0.10  #: Radius of the discs.
    force: bool = False  #: Replace an existing file.
