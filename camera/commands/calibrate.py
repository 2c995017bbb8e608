"""``camera board`` and ``calibrate``: a page to print; a .cam file from its pictures."""

from __future__ import annotations

import glob
import os
import sys
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import islice
from pathlib import Path

import cv2
import numpy as np

from camera.boards.board import Board, board_of, charuco_of, pdf_of, sheet_of_board, sheet_of_discs
from camera.boards.points import corners_counted, find_board
from camera.calibration.calibrate import (
    BoardView,
    Calibration,
    aspect_of,
    calibrate,
    calibrate_with_free_aspect,
    calibrated_camera,
)
from camera.calibration.consensus import view_rms
from camera.calibration.model import INTRINSICS, CalibrationSettings
from camera.calibration.pictures import drawn_corners, pictures
from camera.camfile import format_camera
from camera.commands.floor import write_picture
from camera.errors import CalibrationError
from camera.model import Camera
from camera.options import Board as BoardCommand
from camera.options import Calibrate
from camera.uncertainty import projection_sigma
from redetect import __version__
from redetect.array_types import GreyImage
from redetect.json_text import json_text
from redetect.storage import IMAGE_SUFFIXES, demand_place, demand_writable, write_bytes
from redetect.storage.images import opened_video, read_grey

#: Number of pictures used to determine the true size of a checkerboard, and least number agreeing.
_COUNTED_PICTURES, _VOTES = 8, 2
#: Advice if a board is in no picture, by its kind.
_NOT_FOUND_ADVICE = {
    "checkerboard": "--rows right? A board of 10 x 7 squares has 9 x 6 inner corners",
    "charuco": "--rows right, and the --dictionary?",
}
_THREE_STATE = {"auto": None, "on": True, "off": False}
#: Endings of the pictures that are written, which no folder's photographs have.
_WRITTEN = (".residuals.png", ".coverage.png", ".corners.png")
#: Files that are read as videos.
VIDEO_SUFFIXES = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg", ".mjpeg")


def perform_board(command: BoardCommand) -> int:
    """Execute the command; returns the exit code."""
    demand_place(command.output, overwrite=command.force)
    if command.board == "discs":
        sheet = sheet_of_discs(command.circle_m, command.columns, command.rows)
    else:
        sheet = sheet_of_board(board_of(command))
    write_bytes(command.output, pdf_of(sheet), overwrite=command.force)
    print(f"written: {command.output}: {sheet.text}; print at 100 %, measure the bar")
    return 0


def perform_calibrate(options: Calibrate) -> int:
    """Execute the command; returns the exit code."""
    output = options.output
    kinds = ("residuals", "coverage")
    names = {kind: output.with_name(f"{output.stem}.{kind}.png") for kind in kinds}
    # Checked first, not after minutes of work.
    report = output.with_suffix(".json")
    if report == output:
        raise CalibrationError(f"{report}: the report is written there: expected a name in .cam")
    for path in (output, report, *names.values()):
        demand_place(path, overwrite=options.force)
    if options.pictures is not None:
        for name in calibration_files(options.images, options.max_images):
            demand_writable(options.pictures / name)
            # The names of a video's frames begin with its own.
            for place in options.pictures.glob(f"{glob.escape(name)}*.corners.png"):
                demand_place(place, overwrite=options.force)
    board = board_of(options)
    settings = CalibrationSettings(
        aspect=0.5 if options.half else 1.0,
        coefficients=None if options.coefficients == "auto" else int(options.coefficients),
        tangential=_THREE_STATE[options.tangential],
        polynomial=_THREE_STATE[options.polynomial],
        keep_outliers=options.keep_outliers,
    )
    images = partial(calibration_images, options.images, options.max_images)
    if board.kind == "checkerboard":
        board = board_as_counted(images(), board)
    views, size = find_views(images(), board)
    calibrated = calibrate_with_free_aspect if options.free_aspect else calibrate
    calibration = calibrated(views, board, size, settings)
    camera = calibrated_camera(calibration)
    print(describe(calibration, camera))
    print(
        "no pose: sensor2World is the identity; `camera floor` finds it from a picture of the "
        "board on the floor"
    )
    write_bytes(output, format_camera(camera).encode(), overwrite=options.force)
    write_bytes(report, report_text(options, calibration).encode(), overwrite=options.force)
    for name, drawn in pictures(calibration, camera).items():
        write_bytes(names[name], drawn, overwrite=options.force)
    print(f"written: {output}, {', '.join(p.name for p in (report, *names.values()))}")
    if options.pictures is not None:
        for name, image in images():
            if name in calibration.names:
                picture = drawn_corners(image, calibration, calibration.names.index(name))
                place = options.pictures / f"{name.replace(':', '-')}.corners.png"
                write_picture(picture, place, force=options.force)
    return 0


def report_text(options: Calibrate, calibration: Calibration) -> str:
    """The inputs of the calibration, and its residuals, as JSON."""
    adjusted, points = calibration.adjusted, calibration.points
    rms = view_rms(adjusted.residuals, points).tolist()
    views = zip(calibration.names, points.counts.tolist(), rms, strict=True)
    content = {
        "version": __version__,
        "options": vars(options),
        "intrinsics": dict(zip(INTRINSICS, calibration.intrinsics.tolist())),
        "sigma": dict(zip(INTRINSICS, np.sqrt(np.diag(adjusted.covariance)).tolist())),
        "lens": str(calibration.lens),
        "rms_px": adjusted.rms_px,
        "holdout_rms_px": {
            str(lens): error for lens, error in calibration.cross_validation_px.items()
        },
        "views": [dict(zip(("name", "points", "rms_px"), view)) for view in views],
        "left_out": [{"name": name, "rms_px": error} for name, error in calibration.outliers],
        "warnings": calibration.warnings,
    }
    return f"{json_text(content)}\n"


def board_as_counted(images: Iterable[tuple[str, GreyImage]], board: Board) -> Board:
    """The board with the number of corners in the pictures, if that contradicts the given one.

    A larger board contains the given one. A smaller one may be part of a poorly visible board: it
    counts if the given one is in none of the pictures examined.
    """
    given = max(board.columns, board.rows), min(board.columns, board.rows)
    votes: Counter[tuple[int, int]] = Counter()
    seen: list[GreyImage] = []
    for _, image in islice(images, _COUNTED_PICTURES):
        counted = corners_counted(image)
        seen.append(image)
        if counted is not None:
            votes[counted] += 1
        if votes[given] >= _VOTES:
            return board
    counted, count = votes.most_common(1)[0] if votes else (given, 0)
    if counted == given or count < _VOTES:
        return board
    is_larger = counted[0] >= given[0] and counted[1] >= given[1]
    for image in () if is_larger else seen:
        with suppress(CalibrationError):
            find_board(image, board)
            return board
    columns, rows = counted if board.columns >= board.rows else counted[::-1]
    print(
        f"the board has {columns} x {rows} inner corners, by {count} of the first {len(seen)} "
        f"pictures: used instead of {board.columns} x {board.rows}",
        file=sys.stderr,
    )
    return replace(board, columns=columns, rows=rows)


def find_views(
    images: Iterable[tuple[str, GreyImage]], board: Board
) -> tuple[list[BoardView], tuple[int, int]]:
    """Find the board in images; those without it are listed on standard error, and why."""
    if board.kind == "charuco":
        charuco_of(board)
    views: list[BoardView] = []
    without: dict[str, list[str]] = {}
    size: tuple[int, int] | None = None
    for name, image in images:
        found_size = (image.shape[1], image.shape[0])
        if size is not None and found_size != size:
            raise CalibrationError(
                f"{name}: {found_size[0]} x {found_size[1]} pixels, the pictures before "
                f"{size[0]} x {size[1]}: use pictures of one camera, all upright or none"
            )
        size = found_size
        try:
            indices, pixels = find_board(image, board)
        except CalibrationError as error:
            without.setdefault(str(error), []).append(name)
            continue
        views.append(BoardView(name, indices, pixels))
    count = len(views) + sum(map(len, without.values()))
    if size is None or not views:
        raise CalibrationError(
            f"no {board} in any of {count} pictures: are --board, --columns and "
            f"{_NOT_FOUND_ADVICE.get(board.kind, '--rows right?')}"
        )
    for reason, names in without.items():
        print(f"{', '.join(names)}: {reason}", file=sys.stderr)
    print(f"{board}: found in {len(views)} of {count} pictures of {size[0]} x {size[1]}")
    return views, size


def describe(calibration: Calibration, camera: Camera) -> str:
    """Human-readable summary of the result."""
    sigma = np.sqrt(np.diag(calibration.adjusted.covariance))
    free = np.any(calibration.lens.span(None) != 0.0, axis=1)
    count, views = len(calibration.points.board), len(calibration.names)
    lines = [f"intrinsics from {count} points in {views} pictures:"]
    for name, value, s, is_free in zip(INTRINSICS, calibration.intrinsics, sigma, free):
        uncertain = f" +- {s:.2g}{'' if is_free else '  (not fitted)'}" if s else "  (fixed)"
        lines.append(f"  {name:8s} {value:12.6g}{uncertain}")
    ratio = aspect_of(calibration)
    if ratio.sigma > 0.0:
        lines.append(f"scaleY / scaleX {ratio.value:.5f} +- {ratio.sigma:.5f}")
    lines.append(
        f"RMS residual {calibration.adjusted.rms_px:.3f} px (u and v together), noise "
        f"{calibration.adjusted.sigma_px:.3f} px per coordinate"
    )
    for lens, error in calibration.cross_validation_px.items():
        mark = " <- chosen" if lens == calibration.lens else ""
        held = f"{error:.3f} px" if np.isfinite(error) else "none: a pole or fold in the image"
        lines.append(f"RMS in pictures held out, coefficients {lens}: {held}{mark}")
    spread = projection_sigma(camera, calibration.adjusted.covariance)
    lines.append(
        f"standard deviation of the projection: {np.median(spread):.3f} px (median over the "
        f"image), {spread.max():.3f} px at most"
    )
    for name, rms in calibration.outliers:
        lines.append(
            f"excluded: {name}, residuals of {rms:.2f} px (--keep-outliers keeps it)"
            if np.isfinite(rms)
            else f"excluded: {name}, where no pose of the board explains its points"
        )
    lines += [f"warning: {text}" for text in calibration.warnings]
    return "\n".join(lines)


def calibration_files(inputs: Sequence[Path], most: int) -> dict[str, Path]:
    """The photographs, those in folders, and then the videos, by names that differ.

    At most `most` photographs are used, evenly spaced. A file that is named twice is used once.
    Files of the same name in several folders are called by their paths below a common folder.
    """
    if most < 1:
        raise CalibrationError(f"--max-images {most}: expected 1 or more")
    images: list[Path] = []
    videos: list[Path] = []
    for path in inputs:
        if path.is_dir():
            # Hidden files are skipped: some systems keep metadata in ones named ._ and the image.
            images += sorted(
                each
                for each in path.iterdir()
                if each.suffix.lower() in IMAGE_SUFFIXES
                and not each.name.startswith(".")
                and not each.name.endswith(_WRITTEN)
            )
        elif not path.exists():
            raise CalibrationError(f"{path}: no such picture, folder or video")
        elif path.suffix.lower() in VIDEO_SUFFIXES:
            videos.append(path)
        else:
            images.append(path)
    if not images and not videos:
        raise CalibrationError(
            f"no pictures in {', '.join(str(path) for path in inputs)}: expected files ending in "
            f"{' '.join(IMAGE_SUFFIXES)}, or a video"
        )
    images = _each_once(images)
    if len(images) > most:
        images = [images[i] for i in np.linspace(0, len(images) - 1, most).round().astype(int)]
    files = images + _each_once(videos)
    named = {path.name: path for path in files}
    if len(named) < len(files):
        above = os.path.commonpath([path.resolve().parent for path in files])
        named = {str(path.resolve().relative_to(above)): path for path in files}
    return named


def calibration_images(inputs: Sequence[Path], most: int) -> Iterator[tuple[str, GreyImage]]:
    """Names and grey images of `calibration_files`; of a video at most `most`, evenly spaced."""
    for name, path in calibration_files(inputs, most).items():
        if path.suffix.lower() in VIDEO_SUFFIXES:
            yield from _frames(path, name, most)
        else:
            yield name, read_grey(path, CalibrationError)


def _each_once(paths: list[Path]) -> list[Path]:
    return list({path.resolve(): path for path in reversed(paths)}.values())[::-1]


def _frames(path: Path, name: str, most: int) -> Iterator[tuple[str, GreyImage]]:
    error = CalibrationError(f"{path}: not a video that OpenCV can read")
    with opened_video(path, error) as video:
        count = int(video.get(cv2.CAP_PROP_FRAME_COUNT))
        if count <= 0:  # the file does not say, as one of mere pictures
            count = sum(1 for _ in iter(video.grab, False))
    with opened_video(path, error) as video:
        # The frames are spread over the whole video.
        step = max(1, -(-count // most))
        number = taken = 0
        while taken < most and video.grab():
            if number % step == 0:
                good, frame = video.retrieve()
                if not good:
                    raise CalibrationError(f"{path}: frame {number} cannot be read")
                grey = frame if frame.ndim == 2 else cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
                yield f"{name}:{number}", np.asarray(grey, dtype=np.uint8)
                taken += 1
            number += 1
    if taken == 0:
        raise CalibrationError(f"{path}: a video without frames")
    if taken < most and number < count:
        print(f"{path}: only {number} of {count} frames can be read", file=sys.stderr)
