"""Rows of a run from files, and the settings in their heads."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from types import MappingProxyType

from camera import Camera
from detect.errors import DetectError
from detect.options import RowFiles
from detect.projection import DiscProjection
from detect.runs.plan import FramesByImage, tilts_by_image
from detect.settings import CircleSettings
from detect.settings_files import word_value
from detect.sources.image_files import image_name
from detect.sources.interface import ImageRun
from redetect.landmarks import Frame, FrameTilt
from redetect.landmarks.files import FileHead, read_head

KINDS = ("circles", "lines", "markers", "tilt")


def circle_settings_of(head: FileHead) -> CircleSettings:
    """The settings of discs in the head of a file; those that it does not contain are the defaults.

    A DetectError is raised if one has an impossible value.
    """
    known = {each.name for each in fields(CircleSettings)}
    try:
        words = [(name, word) for name, word in head.settings if name in known]
        return CircleSettings(**{n: word_value(CircleSettings, n, word) for n, word in words})
    except DetectError as error:
        raise DetectError(f"{head.name}: {error}") from None


@dataclass(frozen=True)
class ImageRows:
    """Rows of one image: None for kinds without a file, or whose file lacks the image."""

    circles: Frame | None = None
    lines: Frame | None = None
    markers: Frame | None = None
    tilt: FrameTilt | None = None
    reference_circles: Frame | None = None
    reference_lines: Frame | None = None
    unlisted: Frame | None = None  # discs that may be detected but need not be


class RunRows:
    """Files of a run's detected and reference rows by kind; only their indices are in memory."""

    def __init__(
        self, detected: Mapping[str, Path], reference: Mapping[str, Path] = MappingProxyType({})
    ) -> None:
        self.detected = detected
        self.reference = reference
        self.heads = {kind: read_head(path) for kind, path in detected.items()}
        files = {kind: path for kind, path in detected.items() if kind != "tilt"}
        files |= {f"reference_{kind}": path for kind, path in reference.items()}
        if "circles" in reference:
            unlisted = reference["circles"].parent / "unlisted.circles"
            files |= {"unlisted": unlisted} if unlisted.is_file() else {}
        self._frames = {kind: FramesByImage(path) for kind, path in files.items()}
        self._tilts = tilts_by_image(detected["tilt"]) if "tilt" in detected else {}

    @cached_property
    def circle_settings(self) -> CircleSettings:
        """The settings with which discs were detected."""
        return circle_settings_of(self.heads.get("circles", FileHead()))

    def of(self, prefix: str) -> ImageRows:
        """The rows of an image, by the prefix of its STEP."""
        frames = {kind: source.get(prefix) for kind, source in self._frames.items()}
        return ImageRows(**frames, tilt=self._tilts.get(image_name(prefix)))

    def projection(self, camera: Camera) -> DiscProjection:
        """The projection of discs into the images of a camera."""
        level = "circles" in self.reference and read_head(self.reference["circles"]).level
        return DiscProjection(camera, self.circle_settings, level)


def open_rows(run: ImageRun, options: RowFiles) -> RunRows:
    """Find the files of a run's rows, and index them.

    Raises DetectError if there are none, or given reference rows do not exist, and
    redetect.landmarks.LandmarkFileError if one is malformed.
    """
    usual = {
        kind: run.output(kind) if options.rows is None else options.rows / f"detected.{kind}"
        for kind in KINDS
    }
    detected = {kind: path for kind, path in usual.items() if path.is_file()}
    if not detected:
        raise DetectError(
            f"{usual['circles']}: no such file, nor .lines, .markers or .tilt: expected one of "
            "them: run detect all (or circles, lines, markers) on the same images first, or name "
            "their folder by --rows"
        )
    reference: dict[str, Path] = {}
    for kind, named in (("circles", options.reference), ("lines", options.reference_lines)):
        path = named or run.folder / f"map.{kind}"
        if named is not None and not named.is_file():
            raise DetectError(f"{named}: no such file: expected reference rows")
        if named is not None and kind not in detected:
            raise DetectError(f"{named}: nothing to compare: expected {usual[kind]} as well")
        if kind in detected and path.is_file():
            reference[kind] = path
    return RunRows(detected, reference)
