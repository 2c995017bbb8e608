"""The flags of the command ``camera``: one frozen dataclass per command, nothing heavy imported."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, Optional

from tyro.conf import Positional, arg

# For `X | None` tyro imports another library that takes a tenth of a second.
MaybePath = Optional[Path]  # noqa: UP045

BoardKind = Literal["checkerboard", "charuco", "circles", "asymmetric-circles"]
Format = Literal["auto", "cam", "opencv", "ros", "kalibr", "colmap"]


@dataclass(frozen=True, kw_only=True)
class BoardFlags:
    """A printed board.

    Parameters
    ----------
    board : str
        `checkerboard`, `charuco`, `circles` (in rows and columns) or `asymmetric-circles` (every
        other row moved by half a distance).
    columns : int
        Checkerboard: inner corners in a row. ChArUco: squares in a row. Circles: circles in a row.
    rows : int
        Likewise, of a column.
    square_m : float
        Side of a square, or the distance of rows of circles (m).
    marker_m : float
        Side of a ChArUco board's markers (m).
    dictionary : str
        Of a ChArUco board, as OpenCV names it.
    circle_m : float
        Diameter of the circles (m); with it, perspective no longer shifts their middles.
    output : Path
        The .cam file to write.
    force : bool
        Replace existing files.
    """

    output: Annotated[Path, arg(aliases=["-o"])]
    columns: int
    rows: int
    square_m: float
    board: BoardKind = "checkerboard"
    marker_m: float = 0.0
    dictionary: str = "DICT_5X5_100"
    circle_m: float = 0.0
    force: bool = False


@dataclass(frozen=True, kw_only=True)
class BoardOnFloor(BoardFlags):
    """A board that lies on the floor.

    Parameters
    ----------
    floor_origin : two floats
        Where the middle of that board's points lies: X (left) and Y (backward) of the robot, m.
    floor_yaw : float
        By how much that board is turned (degrees): from the robot's X axis (left) to the board's x
        axis, counterclockwise seen from above. 0: a checkerboard's black corner square is at the
        back right, 180: at the front left. With 180 the board appears upright in the image.
    pictures : Path
        Folder for pictures to check by: the corners found and projected in each photograph; of the
        floor's photograph its grid and the horizon, and the floor from above.
    """

    floor_origin: tuple[float, float] = (0.0, 0.0)
    floor_yaw: float = 0.0
    pictures: MaybePath = None


@dataclass(frozen=True, kw_only=True)
class Calibrate(BoardOnFloor):
    """Calibrate a camera from photographs or a video of a board.

    Example: camera calibrate photographs --columns 9 --rows 6 --square-m 0.025 -o my.cam

    With the pose from a photograph of the same board on the floor, its middle 1.5 m ahead of the
    robot: camera calibrate photographs --columns 9 --rows 6 --square-m 0.025
    --floor floor.jpg --floor-origin 0 -1.5 --floor-yaw 180 -o my.cam

    Parameters
    ----------
    images : several Paths
        Photographs, folders of them, or a video.
    half : bool
        Pictures are half-height: every second line of square pixels, as the data set's.
    free_aspect : bool
        Horizontal and vertical scale are independent of each other, unless the pictures leave
        their ratio open. --no-free-aspect: pixels are square (with --half, twice as high as wide).
    coefficients : str
        Number of free radial distortion coefficients, 0 to 5; `auto`: as many as make the error in
        pictures that were held out smaller.
    tangential : str
        Whether the tangential terms p1 and p2 of a decentred lens are free: `on`, `off`, or `auto`:
        if they make that error smaller and are more than noise.
    polynomial : str
        Whether the radial distortion is OpenCV's polynomial k1 k2 k3 instead of the rational
        function: `on` (then --coefficients are 0 to 3), `off`, or `auto`: if fewer coefficients do
        as well then in pictures that were held out, or their error is much smaller.
    keep_outliers : bool
        Keep pictures whose residuals are far above the others'.
    every : int
        Use only every N-th frame of a video.
    max_images : int
        Use at most this many pictures, evenly spaced, and at most this many frames per video.
    floor : Path
        A picture of the board lying on the floor, or a .csv with the columns u,v,x,y of places on
        it (pixels; metres, X left and Y backward of the robot): gives the camera's pose.
    output : Path
        The .cam file. Beside it: .json with everything, and pictures of residuals and coverage.
    """

    images: Positional[tuple[Path, ...]]
    half: bool = False
    free_aspect: bool = True
    coefficients: Literal["auto", "0", "1", "2", "3", "4", "5"] = "auto"
    tangential: Literal["auto", "on", "off"] = "auto"
    polynomial: Literal["auto", "on", "off"] = "auto"
    keep_outliers: bool = False
    every: int = 15
    max_images: int = 60
    floor: MaybePath = None


@dataclass(frozen=True, kw_only=True)
class Board(BoardFlags):
    """Print a calibration board, or discs, as a PDF at true scale.

    Example: camera board --columns 9 --rows 6 --square-m 0.025 -o board.pdf

    Example: camera board --board discs --circle-m 0.2 -o disc.pdf

    Parameters
    ----------
    board : str
        As in `camera calibrate`, or `discs`: landmarks for the floor.
    columns : int
        As in `camera calibrate`; of discs, how many side by side.
    circle_m : float
        Diameter of the circles or discs (m).
    page : str
        The paper, upright or not; `auto`: the smallest that it fits on.
    output : Path
        The PDF to write.
    """

    board: BoardKind | Literal["discs"] = "checkerboard"  # type: ignore[assignment]
    columns: int = 1
    rows: int = 1
    square_m: float = 0.025
    page: Literal["auto", "A4", "A3", "A2", "A1", "A0"] = "auto"


@dataclass(frozen=True, kw_only=True)
class Floor(BoardOnFloor):
    """Give a calibrated camera its pose, from a board or known places on the floor.

    Example: camera floor my.cam floor.jpg --columns 9 --rows 6 --square-m 0.025
    --floor-origin 0 -1.5 --floor-yaw 180 -o placed.cam

    Example: camera floor my.cam places.csv -o placed.cam

    Parameters
    ----------
    camera : Path
        The .cam file; its pose does not matter.
    floor : Path
        A picture of the board lying on the floor, or a .csv with the columns u,v,x,y of places on
        it (pixels; metres, X left and Y backward of the robot).
    """

    camera: Positional[Path]
    floor: Positional[Path]
    columns: int = 0
    rows: int = 0
    square_m: float = 0.0


@dataclass(frozen=True)
class Convert:
    """Convert a calibration from or to another program's format.

    Example: camera convert images/e/e.cam e.opencv.yaml

    Example: camera convert camchain.yaml my.cam --rows halve

    Where the target model contains the source's, its numbers are taken over; else it is fitted to
    the source's pixels over the whole image. The largest deviation is printed, and above
    --limit-px nothing is written.

    Parameters
    ----------
    source : Path
        The calibration to convert.
    target : Path
        The file to write.
    from_format : str
        `auto`: from the file's ending and content.
    to_format : str
        `auto`: from the ending: .cam; cameras.txt; .opencv.yaml, .ros.yaml or .kalibr.yaml, and
        camera_info.yaml, camchain.yaml.
    model : str
        Distortion model of the target: `radtan` (k1 k2 p1 p2, with OpenCV and ROS also k3),
        `rational` (k1 to k6), `fisheye` (equidistant); `auto`: the first of them that is within the
        limit.
    rows : str
        Lines of the image: `same`; `halve`: the source is for full frames, the target for their
        even lines (`half`); `double`: the other way (`nohalf`).
    limit_px : float
        Largest deviation that is accepted, pixels.
    camera_name : str
        Which camera of a file that holds several, such as cam0 (Kalibr) or its number (COLMAP); the
        target's camera is called so, too, where its format can have such a name.
    pose_from : Path
        A .cam file whose pose the .cam file gets; other formats have none, and without this it is
        the identity, until `camera floor` finds it.
    force : bool
        Replace an existing file.
    """

    source: Positional[Path]
    target: Positional[Path]
    from_format: Format = "auto"
    to_format: Format = "auto"
    model: Literal["auto", "radtan", "rational", "fisheye"] = "auto"
    rows: Literal["same", "halve", "double"] = "same"
    limit_px: float = 0.05
    camera_name: str = ""
    pose_from: MaybePath = None
    force: bool = False


@dataclass(frozen=True)
class Level:
    """Find how a camera is mounted by a drive: its constant lean, and its height over the floor.

    The lean is that of the building's verticals; the height follows from discs of known size. The
    lens is taken as calibrated.

    Example: camera level images/e -o level.cam

    Parameters
    ----------
    run : Path
        Images of the drive: what `detect all` takes.
    output : Path
        The .cam file to write.
    camera : Path
        The calibration, if it is not the one beside the images.
    radius_m : float
        Radius of the discs.
    force : bool
        Replace an existing file.
    """

    run: Positional[Path]
    output: Annotated[Path, arg(aliases=["-o"])]
    camera: MaybePath = None
    radius_m: float = 0.10
    force: bool = False
