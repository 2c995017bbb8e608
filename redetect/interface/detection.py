"""Discs, verticals and tilt in one image, and why discs are found in it or not."""

from __future__ import annotations

import html
import os
from dataclasses import dataclass, replace
from functools import cached_property
from numbers import Integral
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from camera import Camera, read_camera
from detect.drawing.frame import draw_explanation, draw_rows, png_of
from detect.errors import DetectError, FrameError
from detect.explanation import DiscExplanation, explain_discs
from detect.grey_values import plain_image
from detect.line_settings import LineSettings
from detect.projection import DiscProjection, image_positions
from detect.row_files import ImageRows
from detect.runs.frame import FrameDetections, detect_batch
from detect.runs.plan import FramePlan, FrameTask
from detect.settings import CircleSettings, Polarity
from detect.sources.grey_images import read_image
from detect.sources.interface import RunFrame, frame_prefix, still
from redetect.array_types import FloatArray
from redetect.json_text import json_text
from redetect.landmarks import Frame, FrameTilt, Step
from redetect.landmarks.axes import MEANING, Axes, covariance_from_dataset, from_dataset
from redetect.messages import counted, excerpt, keywords_named, path_of
from redetect.tables import ByContent, Table, covariance_columns, html_picture, html_table

ImageLike = NDArray[np.uint8] | str | os.PathLike[str]
CameraLike = Camera | str | os.PathLike[str]


class Landmarks(Table):
    """Landmarks of an image as arrays with one row each."""

    def __len__(self) -> int:
        return len(next(iter(vars(self).values())))

    def __getitem__(self, chosen: Any) -> Any:
        """One, by its number, with its values as attributes; some, by a slice, numbers or mask."""
        kind = SimpleNamespace if isinstance(chosen, Integral) else type(self)
        return kind(**{name: values[chosen] for name, values in vars(self).items()})


@dataclass(frozen=True, eq=False, repr=False)
class Discs(Landmarks):
    """Discs on the floor, N of them, in scan order.

    Attributes
    ----------
    u, v : (N,) float64
        Fitted centre in the image, pixels; (0, 0) is the centre of the top left one.
    xy : (N, 2) float64
        Position on the floor, metres, levelled if the tilt is known.
    covariance : (N, 2, 2) float64
        Of `xy`, square metres.
    quality : (N,) float64
        Otsu's quality of the grey values inside and outside the edge, 0 to 1.
    evidence : (N,) float64
        Log-odds that it is a disc; NaN if nothing was fitted.
    """

    u: FloatArray
    v: FloatArray
    xy: FloatArray
    covariance: FloatArray
    quality: FloatArray
    evidence: FloatArray

    def columns(self) -> dict[str, Any]:
        """One row per disc."""
        return {
            "u_px": self.u,
            "v_px": self.v,
            "x_m": self.xy[:, 0],
            "y_m": self.xy[:, 1],
            **covariance_columns(self.covariance),
            "quality": self.quality,
            "evidence": self.evidence,
        }


@dataclass(frozen=True, eq=False, repr=False)
class Verticals(Landmarks):
    """Vertical lines of the building, N of them, the leftmost first.

    Attributes
    ----------
    bearing_rad : (N,) float64
        0 forward, positive to the left, whatever the axes.
    sigma_rad : (N,) float64
        Standard deviations of the bearings.
    inclination_rad : (N,) float64
        Inclination of the plane through the camera and the line (beta of `.lines` files).
    top, bottom : (N, 2) float64
        Ends in the image, pixels u, v.
    """

    bearing_rad: FloatArray
    sigma_rad: FloatArray
    inclination_rad: FloatArray
    top: FloatArray
    bottom: FloatArray

    def columns(self) -> dict[str, Any]:
        """One row per vertical."""
        return {
            "bearing_rad": self.bearing_rad,
            "sigma_rad": self.sigma_rad,
            "inclination_rad": self.inclination_rad,
            "u_top_px": self.top[:, 0],
            "v_top_px": self.top[:, 1],
            "u_bottom_px": self.bottom[:, 0],
            "v_bottom_px": self.bottom[:, 1],
        }


@dataclass(frozen=True, eq=False)
class Tilt(ByContent):
    """The robot's tilt, from the verticals.

    Attributes
    ----------
    pitch_rad, roll_rad : float
        Rotation that levels measured directions: about the robot's axis to the left (pitch) and
        about the other one (roll), that is X and Y of the data set's axes, Y and X of REP 103's.
    covariance : (2, 2) float64
        Of (pitch, roll), square radians.
    lines : int
        Number of verticals that agree with it.
    """

    pitch_rad: float
    roll_rad: float
    covariance: FloatArray
    lines: int


@dataclass(frozen=True, eq=False, repr=False)
class Detection(Table):
    """Detections in one image.

    Attributes
    ----------
    discs : Discs
    verticals : Verticals
    tilt : Tilt or None
        None if too few verticals determine it; the discs' covariances then include that of an
        unknown tilt (`CircleSettings.tilt_sigma_deg`).
    axes : {"dataset", "robotics"}
        Of floor positions and tilt: X left and Y backward, or REP 103's X forward and Y left.
    name : str
        The image's name.
    image : (H, W) uint8
    camera : Camera
    settings : CircleSettings
    frame : redetect.landmarks.Frame
        The same as rows of files, in the data set's axes, for `redetect.landmarks.write_frames`.
    frame_tilt : redetect.landmarks.FrameTilt or None
        The tilt as the row of a `.tilt` file.
    """

    discs: Discs
    verticals: Verticals
    tilt: Tilt | None
    axes: Axes
    name: str
    image: NDArray[np.uint8]
    camera: Camera
    settings: CircleSettings
    frame: Frame
    frame_tilt: FrameTilt | None

    def columns(self) -> dict[str, Any]:
        """Discs, then verticals, one row each; columns of the other kind are NaN."""
        kinds = ["disc"] * len(self.discs) + ["vertical"] * len(self.verticals)
        parts: tuple[Discs | Verticals, ...] = (self.discs, self.verticals)
        return {"kind": kinds} | {
            name: np.concatenate([p.columns().get(name, np.full(len(p), np.nan)) for p in parts])
            for name in (*self.discs.columns(), *self.verticals.columns())
        }

    def to_json(self) -> str:
        """An object with `discs`, `verticals` (lists of records) and `tilt`."""
        content = {
            "image": self.name,
            "axes": self.axes,
            "tilt": None if self.tilt is None else vars(self.tilt),
            "discs": self.discs.records(),
            "verticals": self.verticals.records(),
        }
        return json_text(content)

    def picture(self) -> NDArray[np.uint8]:
        """(S H + h, S W, 3) the image with the detections: blue, green, red; see `draw_rows`."""
        rows = ImageRows(circles=self.frame, lines=self.frame, tilt=self.frame_tilt)
        projection = DiscProjection(self.camera, self.settings)
        return draw_rows(self.image, projection, rows, self.name)

    def __str__(self) -> str:
        words = f"{self.name}: {counted(len(self.discs), 'disc')}, "
        words += f"{counted(len(self.verticals), 'vertical')}, "
        if self.tilt is None:
            return words + "no tilt"
        pitch, roll = np.degrees([self.tilt.pitch_rad, self.tilt.roll_rad])
        return f"{words}pitch {pitch:.2f}, roll {roll:.2f} degrees ({MEANING[self.axes]})"

    def __repr__(self) -> str:
        return f"<{self}>"

    def _repr_png_(self) -> bytes:
        return png_of(self.picture())

    def _repr_html_(self) -> str:
        tables = html_table(self.discs.columns()) + html_table(self.verticals.columns())
        return f"<p>{html.escape(str(self))}</p>{html_picture(self)}{tables}"


@keywords_named()
def detect(
    image: ImageLike,
    camera: CameraLike,
    radius_m: float | None = None,
    polarity: Polarity | None = None,
    *,
    level: bool = True,
    axes: Axes = "dataset",
    settings: CircleSettings | None = None,
    line_settings: LineSettings | None = None,
) -> Detection:
    """Detect discs, verticals and tilt in one image.

    Parameters
    ----------
    image : (H, W) uint8, or path
        Grey values of the camera's size (an array, or a grey image of PIL or PyTorch), or an image
        file (16 bits become 8 by the fewest that hold its values; in `open`, by those of the run).
    camera : Camera, or path
        The calibrated camera, or its `.cam` file.
    radius_m : float, optional
        Radius of the discs, metres; by default that of the settings.
    polarity : {"any", "light", "dark"}, optional
        Which discs to detect; by default that of the settings.
    level : bool
        Correct the discs' positions for the tilt from the verticals.
    axes : {"dataset", "robotics"}
        Axes of the result: X left and Y backward, or REP 103's X forward and Y left.
    settings : CircleSettings, optional
        Settings of the disc detector.
    line_settings : LineSettings, optional
        Settings of the detector of verticals.

    Returns
    -------
    Detection

    Raises
    ------
    detect.errors.FrameError
        If the image cannot be read, is not an 8-bit grey image, or not of the camera's size.
    detect.errors.DetectError
        If a setting is out of its range.
    camera.CameraError
        If the calibration cannot be read.
    """
    return RecordedFrame(frame_of_image(image), camera_of(camera)).detect(
        radius_m, polarity, level=level, axes=axes, settings=settings, line_settings=line_settings
    )


@dataclass(frozen=True, eq=False, repr=False)
class RecordedFrame:
    """One frame of a recording.

    Attributes
    ----------
    frame : detect.sources.interface.RunFrame
        Its odometry step and the source of its image.
    camera : Camera
    """

    frame: RunFrame
    camera: Camera

    def __repr__(self) -> str:
        return f"<frame {self.name}: {self.frame.image or 'image in memory'}>"

    @property
    def name(self) -> str:
        """The image's name."""
        return self.frame.step.prefix

    @property
    def time_s(self) -> float | None:
        """Time of the image, if known."""
        return self.frame.time_s

    @property
    def step(self) -> Step:
        """The robot's motion since the previous frame."""
        return self.frame.step

    @cached_property
    @keywords_named()
    def image(self) -> NDArray[np.uint8]:
        """(H, W) grey values; `detect.errors.FrameError` if they cannot be read."""
        return read_image(self.frame, self.camera)

    @keywords_named()
    def detect(
        self,
        radius_m: float | None = None,
        polarity: Polarity | None = None,
        *,
        level: bool = True,
        axes: Axes = "dataset",
        settings: CircleSettings | None = None,
        line_settings: LineSettings | None = None,
    ) -> Detection:
        """Detect discs, verticals and tilt: see `detect`."""
        if axes not in MEANING:
            meant = " or ".join(f"{word} ({words})" for word, words in MEANING.items())
            raise DetectError(f"axes is {excerpt(axes)}: expected {meant}; robotics are REP 103's")
        if not isinstance(line_settings, LineSettings | None):
            raise DetectError(f"{excerpt(line_settings)}: expected rd.LineSettings(...)")
        chosen = settings_of(settings, radius_m, polarity)
        plan = FramePlan(
            self.camera,
            lines=line_settings or LineSettings(),
            circles=chosen,
            levelling="frame" if level else "none",
        )
        (found,) = detect_batch([FrameTask(self.frame)], plan)
        if found.error is not None:
            raise FrameError(found.error)
        return _detection(found, self.step, self.camera, chosen, axes)


def settings_of(
    settings: CircleSettings | None, radius_m: float | None, polarity: Polarity | None
) -> CircleSettings:
    """Settings with the radius and polarity that are given separately."""
    if isinstance(radius_m, str):
        raise DetectError(
            f"radius_m is {excerpt(radius_m)}: expected metres, which `detect all --radius-m auto` "
            "and detect.radius.find_radius estimate from images"
        )
    if not isinstance(settings, CircleSettings | None):
        raise DetectError(f"settings is {excerpt(settings)}: expected rd.CircleSettings(...)")
    given: dict[str, Any] = {"radius_m": radius_m, "polarity": polarity}
    given = {name: value for name, value in given.items() if value is not None}
    return replace(settings or CircleSettings(), **given)


def camera_of(camera: CameraLike) -> Camera:
    """The given camera, or the one in the given file."""
    if isinstance(camera, Camera):
        return camera
    return read_camera(path_of(camera, "a Camera, or the name of its .cam file", DetectError))


def frame_of_image(image: ImageLike) -> RunFrame:
    """An array or a file as a frame without odometry."""
    # Arrays of NumPy and PyTorch, and PIL's images but for those whose values refer to a palette.
    arrays = hasattr(image, "__array__") or hasattr(image, "__array_interface__")
    if np.ma.is_masked(image):
        raise FrameError("the image has masked pixels: expected one whose values all count")
    if arrays and getattr(image, "mode", "L") != "P":
        return RunFrame(still("image"), None, content=plain_image(np.asarray(image)))
    path = path_of(image, "an array of grey values, or the name of an image file", FrameError)
    if not path.is_file():
        raise FrameError(f"{path}: no such image")
    return RunFrame(still(frame_prefix(path.stem)), path)


def _detection(
    found: FrameDetections, step: Step, camera: Camera, settings: CircleSettings, axes: Axes
) -> Detection:
    assert found.image is not None
    assert found.discs is not None
    assert found.lines is not None
    verticals, lines, discs = found.lines, found.lines.lines, found.discs
    pixels = image_positions(camera, discs.floor_xy, discs.levelled_by)
    return Detection(
        Discs(
            u=pixels[:, 0], v=pixels[:, 1], xy=from_dataset(discs.floor_xy, axes),
            covariance=covariance_from_dataset(discs.covariance, axes),
            quality=discs.quality, evidence=discs.evidence,
        ),
        Verticals(
            bearing_rad=lines.alpha_rad, sigma_rad=lines.sigma_rad, inclination_rad=lines.beta_rad,
            top=camera.distort(lines.ends[:, :2]), bottom=camera.distort(lines.ends[:, 2:]),
        ),
        _tilt_of(found.tilt, axes), axes, step.prefix, found.image, camera, settings,
        frame=Frame(step, (*discs.landmarks(), *verticals.landmarks()), discs.levelled_by),
        frame_tilt=found.tilt,
    )  # fmt: skip


def _tilt_of(tilt: FrameTilt | None, axes: Axes) -> Tilt | None:
    if tilt is None:
        return None
    # About X forward instead of Y backward, the same rotation has the opposite sign.
    sign = 1.0 if axes == "dataset" else -1.0
    covariance = np.array([[tilt.cpp, sign * tilt.cpr], [sign * tilt.cpr, tilt.crr]])
    return Tilt(tilt.pitch, sign * tilt.roll, covariance, tilt.lines)


@dataclass(frozen=True, eq=False, repr=False)
class Explanation(DiscExplanation):
    """Why discs of an image were found or not: candidates, suggestions, and their picture.

    Attributes
    ----------
    image, camera, settings, at, candidates, place, suggestions
        Those of `detect.explanation.DiscExplanation`.
    """

    def picture(self) -> NDArray[np.uint8]:
        """(H + h, W, 3) the image with its candidates, in OpenCV's order blue, green, red."""
        return draw_explanation(self)

    def _repr_png_(self) -> bytes:
        return png_of(self.picture())

    def _repr_html_(self) -> str:
        words = "".join(f"<p>{html.escape(w)}</p>" for w in (self.place, *self.suggestions) if w)
        return words + super()._repr_html_()


@keywords_named()
def explain(
    image: ImageLike,
    camera: CameraLike,
    at: tuple[float, float] | None = None,
    radius_m: float | None = None,
    polarity: Polarity | None = None,
    *,
    settings: CircleSettings | None = None,
) -> Explanation:
    """Explain why candidates for discs in an image are accepted or rejected.

    Parameters
    ----------
    image, camera, radius_m, polarity, settings
        As for `redetect.interface.detection.detect`.
    at : (float, float), optional
        Pixel (u, v) of something that should have been found.

    Returns
    -------
    Explanation

    Raises
    ------
    detect.errors.FrameError
        If the image cannot be read, is not an 8-bit grey image, or not of the camera's size.
    camera.CameraError
        If the calibration cannot be read.
    """
    frame, camera = frame_of_image(image), camera_of(camera)
    chosen = settings_of(settings, radius_m, polarity)
    if at is not None and (np.shape(at) != (2,) or not np.isreal(at).all()):
        raise DetectError(f"at is {excerpt(at)}: expected a pixel (u, v)")
    return Explanation(**vars(explain_discs(read_image(frame, camera), camera, chosen, at)))
