"""The command line: whole sessions of exact corners, what is printed, written and refused."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from camera import write_camera
from redetect.groundtruth.cli import main
from redetect.groundtruth.commands.outputs import progress, provenance
from redetect.groundtruth.markers.session import (
    Network,
    Rig,
    read_network,
    read_rig,
    write_network,
    write_rig,
)
from redetect.groundtruth.trajectories import se3
from redetect.groundtruth.trajectories.streams import (
    PlanarPoses,
    read_planar_poses,
    write_planar_poses,
)
from redetect.landmarks import Frame, Step, write_frames
from tests.groundtruth.markers.scene import box_rig, frames_of, hall_cameras, lens
from tests.groundtruth.markers.test_network import BOARDS, OFFSET, WORLD, shots
from tools.simulator.driving import planar_transform

FloatArray = NDArray[np.float64]
Captured = pytest.CaptureFixture[str]

NAMES = ("a", "b", "c", "d")
SIGMA_PX = 0.1


def drive(count: int) -> tuple[FloatArray, FloatArray]:
    """Times, and x, y, theta along a circle."""
    t = np.arange(count) / 5.0
    angle = 0.4 * t
    return 1000.0 + t, np.column_stack([np.cos(angle), np.sin(angle), angle + np.pi / 2])


def write_session(
    folder: Path,
    *,
    count: int = 20,
    rig: Rig | None = None,
    moved: bool = True,
    seed: int = 5,
) -> Path:
    """A session with a calibration that is a little wrong and says so."""
    generator = np.random.default_rng(seed)
    rig = box_rig() if rig is None else rig
    times, planar = drive(count)
    poses = np.stack([planar_transform(*map(float, row)) for row in planar])
    frames = frames_of(times, poses, rig=rig, sigma_px=SIGMA_PX, seed=seed)
    folder.mkdir()
    for number, name in enumerate(NAMES):
        run = folder / name
        run.mkdir()
        write_camera(lens(), run / f"{name}.cam")
        own = [f for f in frames if f.camera == number]
        write_frames(
            run / "detected.markers",
            [Frame(Step(f.prefix, *[0.0] * 9), f.markers) for f in own],
            head="made by a test",
        )
        rows = "".join(f"{f.prefix} {f.time_s:.6f}\n" for f in own)
        (run / f"{name}.times").write_text("# prefix seconds\n" + rows)
    sigmas = np.array([2e-3] * 3 + [2e-3] * 3) if moved else np.zeros(6)
    network = Network(
        NAMES,
        (lens(),) * 4,
        tuple(f"{name}/{name}.cam" for name in NAMES),
        hall_cameras(4) @ se3.exp(sigmas * generator.normal(size=(4, 6))),
        np.diag(np.tile(sigmas**2, 4)),
    )
    write_network(folder / "network.json", network)
    believed = replace(
        rig,
        robot_from_marker=rig.robot_from_marker
        @ se3.exp(sigmas * generator.normal(size=(len(rig.ids), 6))),
        covariance=np.diag(np.tile(sigmas**2, len(rig.ids))),
    )
    write_rig(folder / "rig.json", believed)
    write_planar_poses(folder / "truth.csv", PlanarPoses(times, planar))
    return folder


def refused(arguments: list[str], names: str, captured: Captured) -> None:
    """Exit code 1 and one line that names the cause."""
    assert main(arguments) == 1
    shown = captured.readouterr()
    (line,) = shown.err.splitlines()
    assert line.startswith("error: ")
    assert names in line


@pytest.mark.lowest
@pytest.mark.long
def test_a_sessions_poses_and_their_score(tmp_path: Path, capsys: Captured) -> None:
    session = write_session(tmp_path / "s")
    report, tum = tmp_path / "report.jsonl", tmp_path / "poses.tum"
    arguments = ["poses", str(session), "--report", str(report), "--tum", str(tum)]
    assert main(arguments) == 0
    assert "20 poses of 20 times: 20 clear" in capsys.readouterr().out
    poses = read_planar_poses(session / "poses.csv")
    assert len(poses) == 20
    beside = json.loads((session / "poses.json").read_text())
    assert beside["settings"]["solver"] == "sqpnp"
    assert set(beside["files"]) == {"rig.json", "network.json"}
    entries = [json.loads(line) for line in report.read_text().splitlines()]
    assert len(entries) == 20
    assert entries[0]["images"] == dict.fromkeys(NAMES, "0000")
    assert all(marker["used"] for entry in entries for marker in entry["markers"])
    assert len(tum.read_text().splitlines()) == 20

    figures = tmp_path / "score.json"
    truth = str(session / "truth.csv")
    assert main(["score", str(session / "poses.csv"), truth, "--json", str(figures)]) == 0
    assert "normalised error squared / dof" in capsys.readouterr().out
    score = json.loads(figures.read_text())
    assert score["poses"] == 20
    assert score["position_mean_m"] < 0.004
    assert abs(score["angle_mean_rad"]) < 0.005
    # One draw of the calibration's errors moves all poses together: wide limits.
    assert 0.02 < score["normalised_error"] < 5.0

    before = (session / "poses.csv").read_bytes()
    refused(arguments, "poses.csv: exists already", capsys)
    assert main([*arguments, "--force"]) == 0
    assert (session / "poses.csv").read_bytes() == before


def test_clocks_of_cameras_that_differ_are_told(tmp_path: Path, capsys: Captured) -> None:
    """They see the robot at different times, so no images contradict each other."""
    session = write_session(tmp_path / "s", count=20, moved=False)
    for name, late_s in zip(NAMES, (0.0, 0.05, 0.1, 0.15)):
        path = session / name / f"{name}.times"
        rows = [row.split() for row in path.read_text().splitlines()[1:]]
        path.write_text("".join(f"{prefix} {float(t) + late_s:.6f}\n" for prefix, t in rows))
    assert main(["poses", str(session)]) == 0
    captured = capsys.readouterr()
    assert "disagree" not in captured.err
    assert "their clocks may be wrong" in captured.err


def test_files_and_settings_that_options_name(tmp_path: Path, capsys: Captured) -> None:
    session = write_session(tmp_path / "s", count=6)
    output = tmp_path / "out.csv"
    arguments = [
        "poses", str(session), "--rig", str(session / "rig.json"),
        "--network", str(session / "network.json"),
        "--solver", "ippe", "-o", str(output),
    ]  # fmt: skip
    assert main(arguments) == 0
    assert len(read_planar_poses(output)) == 6
    beside = json.loads((tmp_path / "out.json").read_text())
    assert beside["settings"]["solver"] == "ippe"
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("spoil", "names"),
    [
        (lambda s: (s / "network.json").unlink(), "network.json: no such file"),
        (lambda s: (s / "rig.json").write_text("{}"), "dictionary is None"),
        (lambda s: (s / "a" / "a.times").write_text("0000 1\n"), "a.times: no time of image 0001"),
        (lambda s: (s / "a" / "a.times").unlink(), "a.times: no such file"),
        (lambda s: (s / "b" / "detected.markers").write_text("STEP\n"), "detected.markers:1"),
        (lambda s: (s / "b").rename(s / "x"), "b/b.cam"),
    ],
)
def test_sessions_that_lack_something_are_refused(
    tmp_path: Path, capsys: Captured, spoil: object, names: str
) -> None:
    session = write_session(tmp_path / "s", count=2)
    spoil(session)  # type: ignore[operator]
    refused(["poses", str(session)], names, capsys)
    assert not (session / "poses.csv").exists()


def test_nothing_to_work_on_is_refused(tmp_path: Path, capsys: Captured) -> None:
    refused(["poses", str(tmp_path / "absent")], "no such folder", capsys)
    refused(["poses", str(tmp_path)], "no detected.markers in its folders", capsys)
    session = write_session(tmp_path / "s", count=2)
    network = json.loads((session / "network.json").read_text())
    del network["cameras"]["b"], network["covariance"]
    (session / "network.json").write_text(json.dumps(network))
    refused(["poses", str(session)], "b: is not a camera of the network", capsys)


def test_a_rig_that_nobody_saw_gives_no_poses(tmp_path: Path, capsys: Captured) -> None:
    session = write_session(tmp_path / "s", count=2)
    other = replace(box_rig(1), ids=(200,))
    write_rig(session / "rig.json", other, overwrite=True)
    refused(["poses", str(session)], "no pose", capsys)
    assert not (session / "poses.csv").exists()


@pytest.mark.long
def test_a_rig_from_a_session(tmp_path: Path, capsys: Captured) -> None:
    rig = box_rig()
    session = write_session(tmp_path / "s", count=25, moved=False)
    known = tmp_path / "known.json"
    write_rig(known, Rig("rawseeds", (33,), rig.widths_m[2:3], rig.robot_from_marker[2:3],
                         np.zeros((6, 6))))  # fmt: skip
    runs = [str(session / name) for name in NAMES]
    output = tmp_path / "rig.json"
    options = ["--width-m", "0.24", "-o", str(output)]
    assert main(["rig", *runs, *options, "--robot", str(known)]) == 0
    assert "6 markers" in capsys.readouterr().out
    found = read_rig(output)
    error = se3.log(se3.inverse(rig.robot_from_marker) @ found.robot_from_marker)
    assert np.abs(error).max() < 6e-3
    sigmas = np.sqrt(np.diagonal(found.covariance)).reshape(6, 6)
    assert np.all(np.abs(error) < 5.0 * sigmas + 1e-12)
    assert output.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    content = json.loads(output.read_text())
    assert content["made_by"]["settings"]["least_support"] == 3
    assert {row["marker"] for row in content["residuals"]} == set(rig.ids)
    refused(["rig", *runs, *options], "rig.json: exists already", capsys)

    together = ["--force", "--network", str(session / "network.json"), "--robot", str(known)]
    assert main(["rig", *runs, *options, *together]) == 0
    found = read_rig(output)
    assert found.ids == rig.ids
    error = se3.log(se3.inverse(rig.robot_from_marker) @ found.robot_from_marker)
    assert np.abs(error).max() < 6e-3
    assert "m wide" not in capsys.readouterr().err

    wrong = ["--width-m", "0.25", "-o", str(output), *together[:3]]
    assert main(["rig", *runs, *wrong]) == 0
    assert "m wide (sigma" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("width", "names"),
    [
        ("0", "width_m is 0"),
        ("200", "expected metres above 0, at most 10 (200 mm are 0.2)"),
        ("0.2", "['aruco', 'rawseeds'] in the images: expected markers of one"),
    ],
)
def test_rigs_that_cannot_be_made_are_refused(
    tmp_path: Path, capsys: Captured, width: str, names: str
) -> None:
    session = write_session(tmp_path / "s", count=2)
    detected = session / "a" / "detected.markers"
    detected.write_text(detected.read_text().replace("rawseeds", "aruco", 1))
    output = tmp_path / "rig.json"
    refused(["rig", str(session / "a"), "--width-m", width, "-o", str(output)], names, capsys)
    assert not output.exists()
    run, options = str(session / "a"), ["--width-m", "0.2", "-o", str(output)]
    refused(["rig", run, f"{run}/../a", *options], "each of them once", capsys)
    refused(["rig", *options], "expected one or more run folders", capsys)
    both = ["--reference", "33", "--robot", str(session / "rig.json")]
    refused(["rig", run, *options, *both], "--reference is of no use with --robot", capsys)
    (session / "a" / "a.cam").rename(session / "a" / "x.cam")
    write_camera(lens(), session / "a" / "y.cam")
    command = ["rig", str(session / "a"), "--width-m", "0.2", "-o", str(output)]
    refused(command, "several calibrations (x.cam, y.cam): name one a.cam", capsys)


@pytest.mark.parametrize(
    "words",
    [
        ["fuse", "odometry.csv", "--laser", "laser.csv", "-o", "{}/fused.json"],
        [
            "fuse",
            "odometry.csv",
            "--laser",
            "laser.csv",
            "-o",
            "{}/fused",
            "--filtered",
            "{}/x/../fused",
        ],
    ],
)
def test_two_outputs_in_one_place_are_refused(
    tmp_path: Path, capsys: Captured, words: list[str]
) -> None:
    refused([word.format(tmp_path) for word in words], "two of the outputs", capsys)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("flag", [("poses", "--outlier-sigma"), ("laser", "--average")])
def test_settings_that_cannot_be_are_a_wrong_command_line(
    capsys: Captured, flag: tuple[str, str]
) -> None:
    with pytest.raises(SystemExit) as caught:
        main([flag[0], "somewhere", flag[1], "0"])
    assert caught.value.code == 2
    assert f"{flag[1]} is 0" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("flags", "names"),
    [
        (["--largest-gap-s", "nan"], "--largest-gap-s is nan"),
        (["--largest-gap-s", "-1"], "--largest-gap-s is -1"),
        (["--rpe-step", "0"], "--rpe-step is 0"),
        (["--rpe-longest-s", "5"], "--rpe-longest-s is of no use: expected --rpe-step"),
    ],
)
def test_flags_of_scores_are_checked_first(capsys: Captured, flags: list[str], names: str) -> None:
    with pytest.raises(SystemExit) as caught:
        main(["score", "absent.csv", "absent.csv", *flags])
    assert caught.value.code == 2
    assert names in capsys.readouterr().err


def test_files_of_one_name_are_named_by_their_paths(tmp_path: Path) -> None:
    files = [tmp_path / "a" / "poses.csv", tmp_path / "b" / "poses.csv", tmp_path / "clock.json"]
    for number, path in enumerate(files):
        path.parent.mkdir(exist_ok=True)
        path.write_text(str(number))
    named = provenance(None, files)["files"]
    assert list(named) == [str(files[0]), str(files[1]), "clock.json"]
    assert named[str(files[0])] != named[str(files[1])]


@pytest.mark.long
def test_a_network_from_corners(
    tmp_path: Path, capsys: Captured, monkeypatch: pytest.MonkeyPatch
) -> None:
    views = [(view, number) for number, shot in enumerate(shots(0.1, 8)) for view in shot]
    monkeypatch.setattr(
        "redetect.groundtruth.commands.markers.view_of_board",
        lambda image, *_: views[int(image.image.stem)][0],
    )
    folder = tmp_path / "boards"
    folder.mkdir()
    for name in NAMES:
        (folder / name).mkdir()
        write_camera(lens(), folder / name / f"{name}.cam")

    def pose(matrix: FloatArray) -> dict[str, list[float]]:
        from redetect.groundtruth.trajectories.se3 import quaternion_xyzw

        return {
            "translation_m": matrix[:3, 3].tolist(),
            "quaternion_xyzw": quaternion_xyzw(matrix).tolist(),
        }

    content = {
        "boards": {
            name: {"columns": b.columns, "rows": b.rows, "square_m": b.square_m}
            for name, b in BOARDS.items()
        },
        "world_from_board": pose(WORLD),
        "first_from_second": pose(OFFSET),
        "images": [
            {
                "camera": view.camera,
                "board": view.board,
                "placement": number,
                "image": f"{view.camera}/{index}.png",
            }
            for index, (view, number) in enumerate(views)
        ],
    }
    (folder / "boards.json").write_text(json.dumps(content))
    (tmp_path / "out").mkdir()
    output = tmp_path / "out" / "network.json"
    for options in ([], ["--force"]):
        if options:  # the offset is estimated then
            del content["first_from_second"]
            (folder / "boards.json").write_text(json.dumps(content))
        assert main(["network", str(folder), "-o", str(output), *options]) == 0
        assert "4 cameras" in capsys.readouterr().out
        network = read_network(output)  # finds the calibrations from where it stands
        assert network.names == NAMES
        error = se3.log(se3.inverse(hall_cameras(4)) @ network.world_from_camera)
        assert np.abs(error).max() < 0.02
        sigmas = np.sqrt(np.diagonal(network.covariance)).reshape(4, 6)
        assert np.all(np.abs(error) < 5.0 * sigmas)
    refused(["network", str(folder), "-o", str(output)], "exists already", capsys)


def test_a_log_gets_no_progress_bar(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Not even where variables of the environment say that it is as good as a terminal."""
    for name in ("FORCE_COLOR", "TTY_COMPATIBLE", "TTY_INTERACTIVE"):
        monkeypatch.setenv(name, "1")
    assert list(progress([1, 2], "poses")) == [1, 2]
    assert capsys.readouterr() == ("", "")


def test_help_needs_nothing_heavy() -> None:
    program = (
        "import sys\n"
        "from redetect.groundtruth.cli import main\n"
        "try:\n    main(['poses', '--help'])\n"
        "except SystemExit as error:\n    assert error.code == 0\n"
        "heavy = {'numpy', 'scipy', 'cv2', 'pycolmap', 'matplotlib', 'numba'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    finished = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False
    )
    assert finished.returncode == 0, finished.stderr
    assert "--solver" in finished.stdout
