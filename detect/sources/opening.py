"""Opens a run by the name of its image source."""

from __future__ import annotations

import math
import re
from contextlib import suppress
from functools import partial
from pathlib import Path

from camera import Camera, read_camera
from detect.errors import DetectError
from detect.options import SourceOptions
from detect.sources.grey_images import bit_depth_of
from detect.sources.image_files import WILDCARDS, ImageFiles
from detect.sources.interface import Frames, ImageRun, Run, SomeFrames, Source
from detect.sources.poses import FramesAlongPoses, PoseStream, tick_poses, tum_poses, velocity_poses
from detect.sources.video import LiveCamera, VideoFile
from redetect.landmarks import LandmarkError, read_steps
from redetect.storage import IMAGE_SUFFIXES

#: Extensions of bags that are a single file.
_BAG_SUFFIXES = frozenset({".bag", ".mcap", ".db3"})
_LIVE = re.compile(r"camera:([0-9]{1,4})")


def open_run(
    name: Path, camera: Camera | Path | None = None, options: SourceOptions | None = None
) -> Run:
    """Open a run by the name of its image source, with a calibration.

    Parameters
    ----------
    name : path
        A run folder, a folder, image or pattern of images, a video, a bag, or ``camera:0``.
    camera : Camera, or path, optional
        By default the calibration beside the images (``<run>.cam`` if a run folder has several).
    options : SourceOptions, optional

    Raises
    ------
    DetectError
        If the source does not exist or cannot be read, or there is no calibration.
    camera.CameraError, redetect.landmarks.LandmarkFileError
        If the calibration or the odometry cannot be read, or there are several calibrations.
    """
    run = open_source(name, camera, options, posed=True)
    if isinstance(run, Run):
        return run
    raise DetectError(
        f"{name}: no calibration: expected a .cam file beside the images, or one named by "
        "--camera; `camera calibrate` makes one, `camera convert` converts one"
    )


def open_source(
    name: Path,
    camera: Camera | Path | None = None,
    options: SourceOptions | None = None,
    *,
    posed: bool = False,
) -> ImageRun:
    """Open a source with or without a calibration; without one the result is not a `Run`.

    Parameters and errors as for `open_run`. If `posed`, a calibration without a pose is ignored.
    """
    options = options or SourceOptions()
    source = _source(name, options)
    of_wheels = options.wheel_base_m or options.metres_per_tick
    if of_wheels and not options.odometry.endswith(".ticks"):
        raise DetectError(
            "--wheel-base-m, --metres-per-tick: expected counts of wheel encoders beside them: "
            "--odometry FILE.ticks"
        )
    if isinstance(camera, Path):
        camera = read_camera(camera)
    elif camera is None:
        camera = source.calibration(posed=posed)
    frames: Frames
    odometry: Path | None
    own = None
    if isinstance(source, ImageFiles) and not options.odometry:
        own = _steps_of_folder(name)
    if isinstance(source, ImageFiles) and own is not None:
        frames, odometry, has_times = source.along(own), own, bool(options.times)
    else:
        frames, odometry = _frames(source, options)
        has_times = source.has_times
    # Errors in the poses are those of the run.
    plain = source if isinstance(frames, FramesAlongPoses) else frames
    bit_depth = None if source.is_8_bit else bit_depth_of(plain, camera)
    if options.bit_depth is not None:
        if bit_depth is None:
            raise DetectError(
                f"{source.name}: --bit-depth {options.bit_depth}: expected images whose values are "
                "stored in 16 bits"
            )
        bit_depth = options.bit_depth
    if options.frames or bit_depth:
        frames = SomeFrames(frames, options.frames, bit_depth=bit_depth)
    base = source.output_base
    run = ImageRun(base.parent, frames, odometry, base, has_times=has_times, bit_depth=bit_depth)
    return run if camera is None else Run(**vars(run), camera=camera)


def _steps_of_folder(folder: Path) -> Path | None:
    """The STEP rows of a run folder in the data set's layout, which may have been renamed."""
    for path in (folder / f"{folder.resolve().name}.txt", folder / "map.circles"):
        if path.is_file():
            return path
    found = []
    for path in sorted(folder.glob("*.txt")):
        with suppress(LandmarkError, OSError):
            found += [path] if next(read_steps(path), None) else []
    return found[0] if len(found) == 1 else None


def demand_recording(name: Path) -> None:
    """Raise DetectError for a live camera, since existing rows do not belong to its images."""
    if _LIVE.fullmatch(str(name)):
        raise DetectError(
            f"{name}: its images are not those of the rows any more: expected a recording: a "
            "folder or pattern of images, a video or a bag"
        )


def _source(name: Path, options: SourceOptions) -> Source:
    is_bag = _is_ros2_bag(name) or name.suffix.lower() in _BAG_SUFFIXES
    if is_bag and name.exists():
        from detect.sources.bag import Bag  # importing takes as long as everything else

        return Bag(name, options.image_topic)
    if options.image_topic and not is_bag:
        raise DetectError(f"{name}: --image-topic {options.image_topic}: only bags have topics")
    if live := _LIVE.fullmatch(str(name)):
        return LiveCamera(int(live[1]))
    if name.is_file() and name.suffix.lower() not in IMAGE_SUFFIXES:
        return VideoFile(name)
    if name.exists() or WILDCARDS & set(str(name)):
        return ImageFiles(name, options.times)
    raise DetectError(
        f"{name}: no such folder or file: expected a run folder, a folder of images, a pattern "
        "of images in quotes ('drive/*.png'), a video, a bag (.bag, .mcap), or camera:0"
    )


def _frames(source: Source, options: SourceOptions) -> tuple[Frames, Path | None]:
    """The frames of a source along the given odometry, and the odometry's file."""
    named, path = options.odometry, Path(options.odometry)
    poses: PoseStream | None
    if options.times and not isinstance(source, ImageFiles):
        raise DetectError(f"{source.name}: --times {options.times}: its images have their own")
    if named.startswith("/") and not (path.suffix or path.exists()):
        poses = source.poses(named)
    elif named.endswith(".tum"):
        poses = PoseStream(named, path, partial(tum_poses, path))
    elif named.endswith(".velocities"):
        poses = PoseStream(named, path, partial(velocity_poses, path), of_arcs=True)
    elif named.endswith(".ticks"):
        wheels = options.wheel_base_m, options.metres_per_tick
        if not all(0.0 < number < math.inf for number in wheels):
            raise DetectError(
                f"{named}: wheel ticks: expected --wheel-base-m and --metres-per-tick above 0"
            )
        poses = PoseStream(named, path, partial(tick_poses, path, *wheels), of_arcs=True)
    elif named and named != "none":
        if not isinstance(source, ImageFiles):
            raise DetectError(
                f"{named}: STEP rows belong to image files: expected a trajectory (.tum), "
                f"ticks (.ticks), velocities (.velocities), a bag's topic or none for {source.name}"
            )
        return source.along(path), path
    else:
        poses = None if named else source.poses(None)
    if poses is None:
        return source, None
    if not source.has_times:
        raise DetectError(
            f"{source.name}: no times of the images, which a trajectory needs: "
            "give a file of rows 'prefix seconds' by --times"
        )
    return FramesAlongPoses(source, poses), poses.path


def _is_ros2_bag(name: Path) -> bool:
    try:
        with (name / "metadata.yaml").open("rb") as stream:
            return b"rosbag2_bagfile_information" in stream.read(4096)
    except OSError:
        return False
