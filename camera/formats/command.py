"""``camera convert``: calibrations from and to other programs' formats."""

from __future__ import annotations

from pathlib import Path

from camera.camfile import LARGEST_FILE_BYTES, format_camera, parse_camera, read_camera
from camera.errors import ConversionError
from camera.formats import conversion, yaml_files
from camera.formats.colmap import format_colmap, parse_colmap
from camera.formats.conversion import AnyCamera, Converted
from camera.formats.models import ForeignCamera, Model
from camera.model import Camera
from camera.options import Convert, Format
from redetect.storage import bounded, demand_place, write_bytes

#: The models of each format, the simplest first, and their number of coefficients: some formats
#: lack k3.
MODELS: dict[str, dict[Model, int]] = {
    "opencv": {"radtan": 5, "rational": 8, "fisheye": 4},
    "ros": {"radtan": 5, "rational": 8, "fisheye": 4},
    "kalibr": {"radtan": 4, "fisheye": 4},
    "colmap": {"radtan": 4, "rational": 8, "fisheye": 4},
}
# Formats by parts of a YAML file's name.
_YAML_NAMES: dict[str, Format] = {
    "opencv": "opencv",
    ".ros.": "ros",
    "camera_info": "ros",
    "kalibr": "kalibr",
    "camchain": "kalibr",
}


def perform(options: Convert) -> int:
    """Execute the command; returns the exit code."""
    demand_place(options.target, overwrite=options.force)
    text = read_text(options.source)
    from_format = format_of_text(options.source, text)
    to_format = format_of_name(options.target)
    source = parse(text, from_format, str(options.source), options.camera_name)
    try:
        converted = convert(source, to_format, options)
    except ConversionError as error:
        raise ConversionError(f"{options.source}: {error}") from None
    camera = converted.camera
    label = camera.model if isinstance(camera, ForeignCamera) else _label(camera)
    u, v = converted.at
    print(
        f"{options.source} ({from_format}, {source.width} x {source.height}) to {to_format} "
        f"({label}, {camera.width} x {camera.height}): largest deviation over the image "
        f"{converted.deviation_px:.3g} px, at ({u:.0f}, {v:.0f})"
    )
    if not converted.deviation_px <= options.limit_px:
        raise ConversionError(
            f"{options.target}: not written, since {converted.deviation_px:.3g} px is above "
            f"--limit-px {options.limit_px:g}: choose another --model or format, or raise the limit"
        )
    if isinstance(camera, Camera) and camera.seen_share < 1.0:
        unseen = 100.0 * (1.0 - camera.seen_share)
        print(f"{unseen:.1f} % of the image, past the distortion's fold, see nothing")
    if isinstance(camera, Camera) and not isinstance(source, Camera) and options.pose_from is None:
        print(
            "no pose: sensor2World is the identity; give --pose-from, or let `camera floor` find it"
        )
    if isinstance(source, Camera) and not isinstance(camera, Camera):
        print("the pose is dropped: the format has none (--pose-from restores it)")
    write_bytes(options.target, format_of(camera, to_format).encode(), overwrite=options.force)
    print(f"written: {options.target}")
    return 0


def read_text(path: Path) -> str:
    """The text of a calibration file."""
    return bounded.read_text(path, LARGEST_FILE_BYTES, "calibration file", ConversionError)


def _label(camera: Camera) -> str:
    """Name of a camera's distortion model, with its terms."""
    if not any(camera.brown):
        return "rational radial"
    parts = {
        "rational radial": any(camera.coef[:2]),
        "polynomial": any(camera.polynomial),
        "tangential": camera.decentred,
    }
    return ", ".join(name for name, there in parts.items() if there)


def format_of_name(path: Path) -> Format:
    """The format that a file's name implies."""
    name = path.name.lower()
    if name.endswith(".cam"):
        return "cam"
    if name.endswith(".txt") and "cameras" in name:
        return "colmap"
    if name.endswith((".yaml", ".yml")):
        for part, found in _YAML_NAMES.items():
            if part in name:
                return found
    raise ConversionError(
        f"{path}: the name does not say which format: end it in .cam, .opencv.yaml, .ros.yaml, "
        ".kalibr.yaml or cameras.txt"
    )


def format_of_text(path: Path, text: str) -> Format:
    """The format of a file, by its content."""
    if text.lstrip().startswith("{ SmRadial") or path.suffix.lower() == ".cam":
        return "cam"
    if path.suffix.lower() == ".txt":
        return "colmap"
    if text.startswith("%YAML:") or "!!opencv-matrix" in text or text.lstrip().startswith("<"):
        return "opencv"
    content = yaml_files.parse_yaml(text, str(path))
    if yaml_files.kalibr_cameras(content):
        return "kalibr"
    if "distortion_model" in content:
        return "ros"
    if "fisheye_model" in content or "image_width" in content:
        return "opencv"
    raise ConversionError(
        f"{path}: neither a .cam file nor a camera in OpenCV's, ROS's, Kalibr's or COLMAP's format "
        "that is recognised (they have image_width, distortion_model, cam0 with intrinsics, or are "
        "a cameras.txt)"
    )


def parse(text: str, from_format: Format, name: str, camera_name: str = "") -> AnyCamera:
    """A camera of the text of a file."""
    if from_format == "kalibr":
        return yaml_files.parse_kalibr(text, name, camera_name)
    if from_format == "colmap":
        return parse_colmap(text, name, camera_name)
    if from_format == "cam":
        return parse_camera(text, name)
    if from_format == "ros":
        return yaml_files.parse_ros(text, name)
    return yaml_files.parse_opencv(text, name)


def format_of(camera: AnyCamera, to_format: Format) -> str:
    """The text of a file of a camera."""
    if isinstance(camera, Camera):
        return format_camera(camera)
    formats = {
        "opencv": yaml_files.format_opencv,
        "ros": yaml_files.format_ros,
        "kalibr": yaml_files.format_kalibr,
    }
    return formats.get(to_format, format_colmap)(camera)


def convert(source: AnyCamera, to_format: Format, options: Convert) -> Converted:
    """Convert to a model of a format that represents the camera exactly, if there is one.

    Otherwise to the first one within the limit, or the closest one.
    """
    if to_format == "cam":
        pose = read_camera(options.pose_from) if options.pose_from is not None else None
        return conversion.convert_to_camera(source, options.rows, pose)
    models = MODELS[to_format]
    if options.model != "auto":
        if options.model not in models:
            raise ConversionError(
                f"{to_format} has no {options.model} model: expected {' or '.join(models)}"
            )
        models = {options.model: models[options.model]}
    own = source.model if isinstance(source, ForeignCamera) else None
    found: list[Converted] = []
    exact = [model for model in models if conversion.contained(source, model, models[model])]
    for model in sorted(models, key=lambda each: (each not in exact, each != own)):
        found.append(conversion.convert_to_foreign(source, model, options.rows, free=models[model]))
        if found[-1].deviation_px <= options.limit_px:
            break
    return conversion.nearer(*found)
