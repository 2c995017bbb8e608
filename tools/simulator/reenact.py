"""Re-enactment: a recorded run driven again, its discs rendered as the camera would have seen them.

What is taken from the recording: the path, the discs, how the camera was really mounted and tilted
(`tools.reenactment` fits them to the shipped rows). What is made up: a plain floor, far-off walls,
and the photometry, tuned so that the discs' quality falls with distance as that of the
shipped rows.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from camera import Camera, read_camera, write_camera
from camera.uncertainty import exact, with_pose
from redetect.landmarks import Frame, read_frames, wrap_angle, write_frames
from redetect.slam.recording import recording_of_frames
from tools.arrays import BoolArray, ByteArray
from tools.reenactment.world import World, read_world
from tools.simulator.driving import joined_steps
from tools.simulator.files import encoded, rounded, write_bytes, write_truth
from tools.simulator.observation import SeenDisc, see_discs
from tools.simulator.parallel import in_order
from tools.simulator.renderer import Sensor, grey_values, render_light, smeared
from tools.simulator.runs import SIMULATED
from tools.simulator.scene import (
    CEILING_M,
    Construction,
    Flooring,
    FloorMark,
    Look,
    Mark,
    Scene,
    Texture,
    flooring,
    make_scene,
    raster_shape,
)

#: Tuned on the shipped rows' median quality by distance (`detect compare`): no other figure than
#: the blur makes quality fall with distance as it does, and this one fits all distances at once.
REENACTED_SENSOR = Sensor(
    blur_px=6.3,
    video_blur_px=0.5,
    glare=0.03,
    noise_grey=4.0,
    shot_noise_grey=2.0,
    exposure=0.03,
    jpeg_quality=85,
)

_DISC_RADIUS_M = 0.10
_MARGIN_M = 15.0
_WALLS_BEYOND_M = 12.0
_FLOOR_ALBEDO = 0.30
_DISC_ALBEDO = 0.80
_LIGHT_SPREAD = 0.15
_REMEMBERED_FRAMES = 30


@dataclass(frozen=True)
class Reenactment:
    """A recorded run that needs only be rendered."""

    camera: Camera  # As calibrated: what detectors are given.
    world: World
    frames: tuple[Frame, ...]  # The shipped rows, one frame per pose.
    scene: Scene  # The floor with all discs.
    seed: int


@dataclass(frozen=True)
class ReenactedFrame:
    """A rendered frame, and what is truly in view."""

    index: int
    grey: ByteArray
    discs: tuple[SeenDisc, ...]


def prepare(landmarks: Path, camera: Path, world: Path, seed: int) -> Reenactment:
    """Read a recorded run and the world it happened in."""
    found = read_world(world)
    frames = tuple(read_frames(landmarks))
    if [f.step.prefix for f in frames] != [str(p) for p in found.prefixes]:
        raise ValueError(f"{world}: its image prefixes are not those of {landmarks}")
    return Reenactment(read_camera(camera), found, frames, _scene(found, seed), seed)


def reenacted_frame(run: Reenactment, index: int, sensor: Sensor) -> ReenactedFrame:
    """Render what the camera saw after a step."""
    rng = np.random.default_rng(np.random.SeedSequence([run.seed, 1, index]))
    shown = _remembered(run, index)
    camera = true_camera(run, index)
    pose = run.world.poses[index]
    light = render_light(_showing(run.scene, shown), camera, pose)
    motion = pose - run.world.poses[max(index - 1, 0)]
    motion[2] = wrap_angle(motion[2])
    onward = pose + 0.5 * sensor.exposure * motion
    grey = grey_values(smeared(light, camera, pose, onward), sensor, rng)
    ids, xy = run.world.disc_ids[shown], run.world.disc_xy[shown]
    discs = see_discs(run.scene, run.camera, camera, pose, ids, xy, _DISC_RADIUS_M)
    return ReenactedFrame(index, grey, tuple(discs))


def true_camera(run: Reenactment, index: int) -> Camera:
    """The camera as it was mounted and tilted after a step: turned about its own centre."""
    from scipy.spatial.transform import Rotation

    mounting = run.world.robot_from_camera
    p, q = run.world.tilt[index]
    turn = Rotation.from_rotvec([p, q, 0.0]).as_matrix()
    return with_pose(run.camera, np.column_stack([turn @ mounting[:, :3], mounting[:, 3]]))


def write_reenactment(
    run: Reenactment, folder: Path, every: int, *, jobs: int = 1, overwrite: bool = False
) -> int:
    """Render every `every`-th frame of a recorded run and write a run folder.

    Its ``map.circles`` holds the shipped rows of the rendered frames, so that what is detected
    again can be compared with them; odometry between them is joined.

    Returns the number of frames.
    """
    name, sensor = folder.resolve().name, REENACTED_SENSOR
    (folder / "images").mkdir(parents=True, exist_ok=True)
    write_camera(exact(run.camera), folder / f"{name}.cam", overwrite=overwrite)
    indices = range(0, len(run.frames), every)
    truth: list[dict[str, Any]] = []
    for frame in in_order(_rendered, (run, sensor), indices, jobs):
        image = folder / "images" / f"{run.frames[frame.index].step.prefix}.jpg"
        jpeg = encoded(frame.grey, quality=sensor.jpeg_quality)
        write_bytes(image, jpeg, overwrite=overwrite)
        truth.append(_truth_json(run, frame))
    recording = recording_of_frames(run.frames, name)
    steps = joined_steps(recording, indices)
    kept = [Frame(step, run.frames[index].landmarks) for step, index in zip(steps, indices)]
    what = f"re-enactment, every {every}th frame, seed {run.seed}"
    head = SIMULATED.format(what=what).rstrip()
    own = "The images are simulated; the LANDMARK rows below are the recorded run's own."
    write_frames(folder / "map.circles", kept, head=f"{head}\n\n{own}", overwrite=overwrite)
    steps_alone = [Frame(f.step) for f in kept]
    write_frames(folder / f"{name}.txt", steps_alone, head=head, overwrite=overwrite)
    note = {"note": head.split("\n")}
    write_truth(folder / "truth.json", note, {"frames": truth}, overwrite=overwrite)
    return len(indices)


def _rendered(state: tuple[Reenactment, Sensor], index: int) -> ReenactedFrame:
    run, sensor = state
    return reenacted_frame(run, index, sensor)


def _scene(world: World, seed: int) -> Scene:
    """A plain floor with the discs, and walls far from all of them."""
    from scipy.ndimage import gaussian_filter

    building = Construction()
    building.marks += [
        FloorMark(Mark.DISC, float(x), float(y), _DISC_RADIUS_M, _DISC_ALBEDO, disc_id=int(number))
        for number, (x, y) in zip(world.disc_ids, world.disc_xy)
    ]
    places = np.concatenate([world.disc_xy, world.poses[:, :2]])
    low, high = places.min(axis=0) - _MARGIN_M, places.max(axis=0) + _MARGIN_M
    extent = (float(low[0]), float(low[1]), float(high[0]), float(high[1]))
    a = places.min(axis=0) - _WALLS_BEYOND_M
    b = places.max(axis=0) + _WALLS_BEYOND_M
    ring = [a, np.array([b[0], a[1]]), b, np.array([a[0], b[1]])]
    for k in range(4):
        building.upright(ring[k], ring[(k + 1) % 4], 0.0, CEILING_M, Look(Texture.WALL, 0.6, 0.2))
    shape = raster_shape(extent)
    scene = make_scene(
        building, extent, np.zeros(shape, dtype=np.int8),
        np.array([flooring(Flooring.LINOLEUM, _FLOOR_ALBEDO, 0.08, 0.0)]),
        np.ones(shape, dtype=np.uint8), lit=False,
    )  # fmt: skip
    # Light that changes slowly from place to place, as below lamps.
    rng = np.random.default_rng(np.random.SeedSequence([seed, 0]))
    uneven = gaussian_filter(rng.standard_normal(shape), 10.0)
    light = 1.0 + _LIGHT_SPREAD * uneven / uneven.std()
    side = np.zeros((*shape, 3))
    side[..., 0] = light
    return scene._replace(floor_light=light, side_light=side)


def _remembered(run: Reenactment, index: int) -> BoolArray:
    """Discs that are reported some frames before or after: what walls hide is not shown."""
    near = run.frames[max(index - _REMEMBERED_FRAMES, 0) : index + _REMEMBERED_FRAMES + 1]
    ids = {i for frame in near for row in frame.circles for i in row.ids}
    return np.isin(run.world.disc_ids, list(ids))


def _showing(scene: Scene, shown: BoolArray) -> Scene:
    """The same floor with some of its discs."""
    keep = shown[scene.mark_items]
    counted = np.concatenate([[0], np.cumsum(keep)])
    return scene._replace(
        mark_items=scene.mark_items[keep], mark_start=counted[scene.mark_start].astype(np.int64)
    )


def _truth_json(run: Reenactment, frame: ReenactedFrame) -> dict[str, Any]:
    return {
        "prefix": run.frames[frame.index].step.prefix,
        "pose": rounded(run.world.poses[frame.index], 9),
        "tilt": rounded(run.world.tilt[frame.index], 9),
        "discs": [
            {"id": d.disc_id, "robot_xy": rounded(d.robot_xy, 6), "pixel": rounded(d.pixel, 3),
             "cut": d.cut}
            for d in frame.discs
        ],
    }  # fmt: skip
