"""The demo session from its images to poses: detection, poses, score."""

from __future__ import annotations

import shutil
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from redetect.groundtruth.cli import main
from redetect.groundtruth.trajectories.streams import read_planar_poses
from redetect.landmarks import Frame, MarkerCorner, MarkerLandmark, write_frames
from tests.groundtruth.comparison import compare_streams


@pytest.mark.long
def test_the_demo_sessions_poses_are_true(project_root: Path, tmp_path: Path) -> None:
    from detect.markers.detect import detect_markers
    from detect.settings import MarkerSettings
    from detect.sources.grey_images import read_image
    from detect.sources.opening import open_run

    session = tmp_path / "m"
    shutil.copytree(project_root / "images" / "m", session)
    for folder in sorted(p for p in session.iterdir() if (p / "images").is_dir()):
        run = open_run(folder)
        settings = MarkerSettings(dictionary="rawseeds")
        frames = []
        for frame in islice(run.frames, 0, None, 3):
            found = detect_markers(read_image(frame, run.camera), settings, run.camera)
            rows = []
            for number in range(len(found)):
                a, b, c, d = (
                    MarkerCorner(
                        float(uv[0]), float(uv[1]),
                        float(cov[0, 0]), float(cov[0, 1]), float(cov[1, 1]),
                    )
                    for uv, cov in zip(found.corners[number], found.covariance[number])
                )  # fmt: skip
                rows.append(MarkerLandmark("rawseeds", int(found.ids[number]), 1.0, (a, b, c, d)))
            frames.append(Frame(frame.step, tuple(rows)))
        write_frames(folder / "detected.markers", frames, overwrite=True)
    assert main(["poses", str(session), "--force"]) == 0
    poses = read_planar_poses(session / "poses.csv")
    truth = read_planar_poses(session / "truth.csv")
    score = compare_streams(poses, truth)
    assert score.poses == len(truth.times_s[::3])
    assert score.position_mean_m < 0.005
    assert abs(np.degrees(score.angle_mean_rad)) < 0.1
    assert 0.2 < score.normalised_error < 2.0
