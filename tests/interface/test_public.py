"""`import redetect as rd`: names, cost, and what each gives."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import types
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, get_type_hints

import cv2
import numpy as np
import pytest

import redetect as rd
from detect.errors import DetectError, FrameError
from redetect.interface.maps import LocalizeOptions, MapOptions
from redetect.landmarks import read_frames, write_frames
from redetect.slam.options import Localize, Map
from redetect.storage import OutputExistsError
from redetect.tables import FrameLibrary, ResultError


def test_importing_costs_nothing(project_root: Path) -> None:
    program = (
        "import sys, redetect\n"
        "print({'numpy', 'numba', 'cv2', 'scipy', 'tyro', 'detect', 'camera'} & set(sys.modules))"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=project_root, capture_output=True, text=True,
        check=True,
    )  # fmt: skip
    assert done.stdout == "set()\n"


def test_every_public_name_is_there() -> None:
    assert dir(rd) == sorted(rd.__all__)
    for name in rd.__all__:
        assert getattr(rd, name).__doc__
    with pytest.raises(AttributeError, match="no_such_name"):
        _ = rd.no_such_name


# -- one image ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def found(demo_image: Path, demo_camera: rd.Camera) -> rd.Detection:
    return rd.detect(demo_image, demo_camera, polarity="light")


def test_it_is_what_the_command_line_finds(
    found: rd.Detection, demo: Path, demo_image: Path, tmp_path: Path
) -> None:
    """Of one image: verticals, the tilt by them, discs that are levelled by that."""
    from detect.cli import main

    flags = ["--camera", str(demo / "e.cam"), "--polarity", "light", "--tilt", "frame"]
    assert main(["all", str(demo_image), *flags, "-o", str(tmp_path)]) == 0
    (frame,) = read_frames(tmp_path / "detected.circles")
    write_frames(tmp_path / "own.circles", [found.frame])
    (own,) = read_frames(tmp_path / "own.circles")
    assert [(r.px, r.py, r.quality, r.cxx, r.cxy, r.cyy) for r in own.circles] == [
        (r.px, r.py, r.quality, r.cxx, r.cxy, r.cyy) for r in frame.circles
    ]
    (frame,) = read_frames(tmp_path / "detected.lines")
    assert [line.alpha for line in frame.lines] == pytest.approx(
        found.verticals.bearing_rad, rel=1e-5
    )


def test_positions_in_the_image_and_on_the_floor_are_the_same_places(
    demo_image: Path, demo_camera: rd.Camera
) -> None:
    found = rd.detect(demo_image, demo_camera, level=False)
    assert len(found.discs) > 10
    seen = demo_camera.project_floor(found.discs.xy)
    np.testing.assert_allclose(np.stack([found.discs.u, found.discs.v], axis=1), seen, atol=1e-9)
    assert np.any(np.abs(found.discs.u - np.rint(found.discs.u)) > 0.1)


def test_rep_103_axes(found: rd.Detection, demo_image: Path, demo_camera: rd.Camera) -> None:
    """X forward and Y left: the same vectors and covariances, turned by a quarter."""
    other = rd.detect(demo_image, demo_camera, polarity="light", axes="robotics")
    turn = np.array([[0.0, -1.0], [1.0, 0.0]])
    np.testing.assert_array_equal(other.discs.xy, found.discs.xy @ turn.T)
    np.testing.assert_allclose(
        other.discs.covariance, turn @ found.discs.covariance @ turn.T, rtol=1e-12
    )
    assert np.all(other.discs.xy[:, 0] > 0.0)  # in front
    np.testing.assert_array_equal(other.verticals.bearing_rad, found.verticals.bearing_rad)
    assert found.tilt is not None
    assert other.tilt is not None
    # The rotation about X and Y is a vector, too.
    vector = turn @ [found.tilt.pitch_rad, found.tilt.roll_rad]
    np.testing.assert_allclose([other.tilt.roll_rad, other.tilt.pitch_rad], vector)
    assert other.frame == found.frame
    np.testing.assert_array_equal(other.picture(), found.picture())


def test_radius_and_settings(demo_image: Path, demo_camera: rd.Camera) -> None:
    settings = rd.CircleSettings(polarity="dark", threshold=0.9)
    found = rd.detect(demo_image, demo_camera, radius_m=0.06, settings=settings)
    assert found.settings == rd.CircleSettings(polarity="dark", threshold=0.9, radius_m=0.06)
    single: Any = np.float32(0.0625)
    assert type(rd.detect(demo_image, demo_camera, radius_m=single).settings.radius_m) is float
    with pytest.raises(rd.Error, match="radius_m is -1"):
        rd.detect(demo_image, demo_camera, radius_m=-1.0)
    wrong: Any = "grey"
    with pytest.raises(rd.Error, match="polarity is 'grey': expected one of any, light, dark"):
        rd.detect(demo_image, demo_camera, polarity=wrong)
    with pytest.raises(rd.Error, match="axes is 'grey': expected robotics"):
        rd.detect(demo_image, demo_camera, axes=wrong)


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((288, 768, 3), np.uint8),
        np.zeros((288, 768), np.uint16),
        np.zeros((10, 10), np.uint8),
        np.ma.masked_less(np.zeros((288, 768), np.uint8), 1),
        "no/such/image.png",
    ],
)
def test_images_that_are_refused(image: Any, demo_camera: rd.Camera) -> None:
    for search in (rd.detect, rd.explain):
        with pytest.raises(FrameError) as error:
            search(image, demo_camera)
        assert "\n" not in str(error.value)


def test_files_of_colours_can_be_named(
    found: rd.Detection, demo_image: Path, demo: Path, tmp_path: Path
) -> None:
    grey = cv2.imread(str(demo_image), cv2.IMREAD_GRAYSCALE)
    assert grey is not None
    path = tmp_path / "#in colour.png"
    cv2.imwrite(str(path), cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR))
    other = rd.detect(path, demo / "e.cam", polarity="light")
    np.testing.assert_array_equal(other.discs.xy, found.discs.xy)
    assert other.name == "_in_colour"


def test_json(found: rd.Detection) -> None:
    content = json.loads(found.to_json())
    assert [disc["u_px"] for disc in content["discs"]] == found.discs.u.tolist()
    assert [line["bearing_rad"] for line in content["verticals"]] == (
        found.verticals.bearing_rad.tolist()
    )
    assert content["axes"] == "dataset"
    assert content["tilt"]["lines"] > 5


def test_notebooks_show_pictures_and_tables(found: rd.Detection, demo: Path) -> None:
    picture = cv2.imdecode(np.frombuffer(found._repr_png_(), np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    assert picture.shape[0] > found.image.shape[0]
    page = found._repr_html_()
    assert page.count("<tr>") == 2 + len(found.discs) + 20  # of the verticals
    assert "and 1 more rows" in page
    assert "data:image/png;base64," in page
    assert len(repr(found)) < 200
    assert len(repr(found.discs)) < 200
    assert len(repr(rd.open(demo)[0])) < 200


@pytest.mark.parametrize("name", ["pandas", "polars"])
def test_data_frames(
    found: rd.Detection, name: FrameLibrary, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By a stand-in of the library that keeps the columns, where it isn't installed."""
    for other in {"pandas", "polars"} - {name}:
        monkeypatch.setitem(sys.modules, other, None)
    monkeypatch.setitem(sys.modules, name, types.SimpleNamespace(DataFrame=dict))
    columns = found.to_dataframe()
    count = len(found.discs) + len(found.verticals)
    assert {len(column) for column in columns.values()} == {count}
    assert columns["kind"][0] == "disc"
    assert np.isnan(columns["bearing_rad"][0])
    assert found.discs.to_dataframe(name).keys() == found.discs.columns().keys()


def test_without_a_library_of_data_frames(
    found: rd.Detection, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("pandas", "polars"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ResultError, match="pandas or polars is not installed: pip install pandas"):
        found.to_dataframe()


def test_parts_and_equality(found: rd.Detection, demo_image: Path, demo_camera: rd.Camera) -> None:
    again = rd.detect(demo_image, demo_camera, polarity="light")
    assert found == again
    assert found.tilt == again.tilt
    assert found != rd.detect(demo_image, demo_camera, polarity="light", level=False)
    assert found != found.name
    assert found.discs == found.discs[:] != found.discs[1:]
    clear = found.discs[found.discs.evidence > 3.0]
    assert 0 < len(clear) < len(found.discs)
    assert found.verticals[-1].bearing_rad == found.verticals.bearing_rad[-1]
    assert [disc.u for disc in clear] == clear.u.tolist()
    undone = replace(found.discs, evidence=np.full(len(found.discs), np.nan))
    assert undone == replace(undone)


@pytest.mark.parametrize("interface", ["__array__", "__array_interface__"])
def test_images_of_other_libraries(
    interface: str, found: rd.Detection, demo_camera: rd.Camera
) -> None:
    """PyTorch's have `__array__`, PIL's `__array_interface__`; palettes are not grey values."""
    attribute = getattr(found.image, interface)
    kind = type("Image", (), {interface: attribute, "mode": "L"})
    assert ANY.detect(kind(), demo_camera).discs == rd.detect(found.image, demo_camera).discs
    kind.mode = "P"  # type: ignore[attr-defined]
    with pytest.raises(rd.Error, match="expected an array of grey values"):
        ANY.detect(kind(), demo_camera)


#: The API for arguments that type checkers refuse.
ANY: Any = rd


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda one: ANY.detect(None, one.camera), "None: expected an array of grey values, or"),
        (lambda one: ANY.detect([one.image], one.camera), "expected an array of grey values, or"),
        (lambda one: ANY.detect(one.image / 255.0, one.camera), r"\(255 \* image\)\.astype"),
        (lambda one: ANY.detect(one.image[:9], one.camera), "of these images by `camera`$"),
        (lambda one: ANY.detect(one.image, {}), "expected a Camera, or the name of its .cam file"),
        (lambda one: ANY.detect(one.image, one.camera, "auto"), "expected metres, which"),
        (lambda one: ANY.detect(one.image, one.camera, settings={}), "expected rd.CircleSettings"),
        (lambda one: ANY.detect(one.image, one.camera, line_settings={}), "expected rd.LineSettin"),
        (lambda one: ANY.detect(one.image, one.camera, axes="rep103"), "robotics are REP 103's"),
        (lambda _: ANY.open(["e"]), "expected the name of a run"),
        (lambda _: ANY.open("docs/images"), "named by `camera`; `camera calibrate`"),
        (lambda _: ANY.open("images/e", odometry=5), "5: expected a name as odometry"),
        (lambda _: ANY.open("images/e", wheel_base_m=-1), "wheel_base_m is -1: expected 0 or more"),
        (lambda one: ANY.compare("images/e", [one.frame]), "expected a Detection, or the name"),
        (lambda one: ANY.compare(one, [one]), "expected a run folder"),
        (lambda one: ANY.map([one]), "expected a run folder or a file of rows"),
        (lambda one: ANY.map("images/e", more=[one]), "expected a run folder or a file of rows"),
        (lambda one: ANY.localize("images/e", one), "expected a RunMap, or its map.csv"),
        (lambda _: ANY.map("images/e", more=5), "5: expected a run folder or a file of rows"),
        (lambda _: ANY.map("images/e", camera=5), "5: expected a Camera, or the name of its .cam"),
        (lambda _: ANY.map("images/e", odometry_noise=0.1), "is 0.1: expected an OdometryNoise"),
        (lambda one: ANY.compare("images/e", one, 5), "5: expected the name of a file of rows"),
        (lambda one: ANY.compare("images/e", one, options=5), "5: expected rd.CompareOptions"),
    ],
)  # fmt: skip
def test_arguments_of_another_kind(
    call: Callable[[Any], Any], words: str, found: rd.Detection, project_root: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.chdir(project_root)
    with pytest.raises(rd.Error, match=words):
        call(found)


# -- runs -----------------------------------------------------------------------------------


def test_frames_of_a_run_and_their_comparison(demo: Path, tmp_path: Path) -> None:
    run = rd.open(demo, frames=3)
    frames = list(run)
    assert [frame.name for frame in frames] == ["e.0000", "e.0001", "e.0002"]
    assert frames[0].image.shape == (run.camera.height, run.camera.width)
    assert frames[1].step.dy != 0.0
    found = [frame.detect(polarity="light") for frame in frames]
    discs = rd.compare(demo, found)
    assert discs.recall == 1.0
    assert "discs of the reference are found, 0 missed, in 3 frames" in discs.sentences()[0]
    assert json.loads(discs.to_json())["matched"] == discs.matched
    sharper = replace(run.camera, scale_x=2.0 * run.camera.scale_x)
    figures = [c.figures() for c in (discs, rd.compare(demo, found, camera=sharper))]
    assert figures[0]["image_median_px"] < figures[1]["image_median_px"]
    verticals = rd.compare(demo, found, lines=True)
    alone = shutil.copy(demo / "map.lines", tmp_path)  # with nothing beside it
    assert "verticals of the reference are found" in verticals._repr_html_()
    assert verticals.columns()["name"] == ["e.0000", "e.0001", "e.0002"]
    assert sum(discs.columns()["matched"]) == discs.matched
    assert str(discs).splitlines() == list(discs.sentences())
    assert rd.compare(demo, found[1]) == rd.compare(demo, iter(found[1:2]))
    assert run[2].detect(polarity="light") == found[2]
    with pytest.raises(TypeError, match="unhashable"):
        hash(found[2])
    without_unlisted = rd.compare(demo, found, alone, lines=True)
    assert verticals.extra < without_unlisted.extra
    with pytest.raises(DetectError, match="nothing to compare"):
        rd.compare(demo, [])


def test_a_recording_is_a_sequence(demo: Path) -> None:
    run = rd.open(demo, frames=3)
    names = [frame.name for frame in run]
    assert len(run) == 3
    assert run[1].step.dy == rd.open(demo, odometry=demo / "e.txt", times=None)[1].step.dy
    assert [run[k].name for k in (-3, -2, -1)] == names
    assert [frame.name for frame in run[::-1]] == names[::-1]
    assert [frame.name for frame in run[1:9]] == names[1:]
    for number in (3, -4):
        with pytest.raises(IndexError, match=f"e has no frame {number}"):
            _ = run[number]
    with pytest.raises(TypeError, match="'float' object cannot be interpreted as an integer"):
        _ = run[1.5]  # type: ignore[call-overload]


def test_a_recording_of_unknown_length(demo: Path, demo_camera: rd.Camera, tmp_path: Path) -> None:
    size = demo_camera.width, demo_camera.height
    path = tmp_path / "a.avi"
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, size)
    for _ in range(3):
        video.write(np.zeros((*size[::-1], 3), np.uint8))
    video.release()
    run = rd.open(path, demo_camera)
    assert run
    names = [frame.name for frame in run]
    assert len(names) == 3
    assert run[2].name == names[2]
    other = rd.open(path, replace(demo_camera, width=2 * demo_camera.width))
    with pytest.raises(rd.Error, match=r"of these images by `camera`$"):
        _ = other[0].image
    for call in (lambda: len(run), lambda: run[-1], lambda: run[-2:]):
        with pytest.raises(rd.Error, match="known only once all frames"):
            call()
    with pytest.raises(IndexError, match="has no frame 3"):
        _ = run[3]


def test_a_run_with_another_camera(demo: Path, demo_camera: rd.Camera) -> None:
    for camera in (demo_camera, demo / "e.cam"):
        (frame,) = rd.open(demo / "images", camera, frames=1)
        assert frame.camera == demo_camera
    other = replace(demo_camera, scale_x=500.0)
    assert rd.open(demo, other).camera == other  # than that of the run folder
    with pytest.raises(rd.Error, match="no such folder"):
        rd.open("no-such-run.mcap")


def test_comparison_of_files(demo: Path, tmp_path: Path) -> None:
    result = rd.compare(demo, demo / "map.circles", demo / "map.circles")
    assert result.recall == result.precision == 1.0
    with pytest.raises(rd.Error, match=r"detected\.circles"):
        rd.compare(tmp_path, reference=demo / "map.circles")


def test_a_lost_robot_is_located_without_a_word(
    demo: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = rd.localize(demo, rd.map(demo), association="joint", lost=True).result.located
    assert found is not None
    assert np.hypot(*found.pose[:2]) < 0.1
    assert capsys.readouterr().out == ""
    with pytest.raises(rd.Error, match="`lost` and `start`: expected one of them"):
        rd.localize(demo, rd.map(demo), lost=True, start=(1.0, 0.0, 0.0))


def test_map_and_localisation(demo: Path, tmp_path: Path) -> None:
    landmarks = rd.map(demo, lines=True)
    assert len(landmarks.discs) > 20
    assert set(landmarks.columns()["kind"]) == {"disc", "vertical"}
    assert len(landmarks.poses().columns()["prefix"]) == len(landmarks.path.poses)
    assert landmarks._repr_png_().startswith(b"\x89PNG")
    assert "data:image/png" in landmarks._repr_html_()
    assert "<table>" in landmarks._repr_html_()
    landmarks.write(tmp_path)
    with pytest.raises(OutputExistsError, match="exists already: give overwrite=True"):
        landmarks.write(tmp_path)
    head = (tmp_path / "map.csv").read_text().splitlines()[:2]
    assert head[0] == f"# redetect.map {rd.__version__}"
    assert '"lines": true' in head[1]
    in_memory = rd.localize(demo, landmarks, lines=True)
    from_file = rd.localize(demo, tmp_path / "map.csv", lines=True)
    np.testing.assert_allclose(in_memory.path.poses, from_file.path.poses, atol=1e-9)
    assert in_memory.distance(landmarks.path)["position_max_m"] < 0.05
    with pytest.raises(rd.Error, match="circles and lines are False"):
        rd.map(demo, circles=False)
    with pytest.raises(rd.Error, match="association is 'all': expected one of known, nearest"):
        rd.localize(demo, landmarks, association="all")  # type: ignore[arg-type]
    with pytest.raises(rd.Error, match=r"^1 poses: expected 81, as in this run"):
        in_memory.distance(landmarks.path.part(0, 1))
    with pytest.raises(rd.Error, match="expected a path, as of a map"):
        in_memory.distance(landmarks)  # type: ignore[arg-type]
    with pytest.raises(rd.Error, match="force, reference: of the command only"):
        rd.localize(demo, landmarks, reference="path.csv", force=True)  # type: ignore[call-arg]
    with pytest.raises(rd.Error, match="calibrat: no such option: expected stem, camera,"):
        rd.map(demo, calibrat=True)  # type: ignore[call-arg]
    with pytest.raises(rd.Error, match=r"start is \(0, 0\): expected three numbers"):
        rd.map(demo, start=(0, 0))
    moved = rd.map(demo, start=np.array([1.0, 2.0, 0.5]))
    np.testing.assert_allclose(moved.path.poses[0], [1.0, 2.0, 0.5])
    by_camera = rd.map(demo, lines=True, camera=rd.Camera.read(demo / "e.cam"))
    np.testing.assert_array_equal(by_camera.path.poses, landmarks.path.poses)
    with pytest.raises(rd.Error, match="library is 'numpy': expected pandas or polars"):
        landmarks.to_dataframe("numpy")  # type: ignore[arg-type]
    for more in (str(demo), [demo]):
        both = rd.map(demo, more=more)
        assert list(both.discs.rows) == [2 * rows for rows in rd.map(demo).discs.rows]
        assert [path.prefixes[0] for path in both.paths] == ["start", "start"]
    both.write(tmp_path / "both")
    assert {file.name for file in (tmp_path / "both").iterdir()} == {
        "map.csv", "map_covariance.npy", "path_1.csv", "path_2.csv",
    }  # fmt: skip
    assert len(repr(landmarks)) < 200
    assert len(repr(in_memory)) < 200


def test_the_joint_covariance_of_too_many_landmarks_is_not_computed(
    demo: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    landmarks = rd.map(demo)
    assert rd.localize(demo, landmarks).landmarks.joint_covariance is not None
    joint = rd.localize(demo, landmarks, association="joint")
    assert joint.landmarks.joint_covariance is not None
    monkeypatch.setattr("redetect.slam.mapping.run_map.MOST_LANDMARKS_TOGETHER", 30)
    assert rd.localize(demo, landmarks).landmarks.joint_covariance is None


@pytest.mark.parametrize(("options", "flags"), [(MapOptions, Map), (LocalizeOptions, Localize)])
def test_options_are_the_flags_of_the_command(options: type, flags: type) -> None:
    of_command = {"run", "circles", "lines", "map", "output", "force", "interactive", "reference"}
    assert get_type_hints(options).keys() == {each.name for each in fields(flags)} - of_command


# -- explanations ---------------------------------------------------------------------------


def test_every_disc_that_is_found_is_explained(
    found: rd.Detection, demo_image: Path, demo_camera: rd.Camera
) -> None:
    why = rd.explain(demo_image, demo_camera, polarity="light")
    assert sum(row.is_disc for row in why.candidates) == len(found.discs)
    stages = {row.stage for row in why.candidates}
    assert {"disc", "steps", "prescreening", "polarity"} <= stages
    for row in why.candidates:
        assert row.is_disc == row.reason().startswith("found")
        assert not row.is_disc or row.contrast > 15.0  # of large discs, too
    content = json.loads(why.to_json())
    assert len(content["candidates"]) == len(why.candidates)
    assert why._repr_png_().startswith(b"\x89PNG")
    assert "data:image/png" in why._repr_html_()


def test_a_disc_whose_centre_is_cut_off(
    found: rd.Detection, demo_image: Path, demo_camera: rd.Camera
) -> None:
    """The image ends two columns before the centre of its clearest disc."""
    image = np.asarray(cv2.imread(str(demo_image), cv2.IMREAD_GRAYSCALE), np.uint8)
    clearest = int(np.argmax(found.discs.evidence))
    width = int(found.discs.u[clearest]) - 2
    why = rd.explain(image[:, :width].copy(), replace(demo_camera, width=width))
    (cut,) = [row for row in why.candidates if row.stage == "outside"]
    assert (cut.u, cut.v) == pytest.approx(
        (found.discs.u[clearest], found.discs.v[clearest]), abs=1.5
    )
    assert "centre is outside the image" in cut.reason()
    assert json.loads(why.to_json())


def test_the_wrong_polarity_is_named(
    found: rd.Detection, demo_image: Path, demo_camera: rd.Camera
) -> None:
    why = rd.explain(demo_image, demo_camera, polarity="dark")
    assert any("--polarity any finds" in words for words in why.suggestions)
    assert any(row.stage == "polarity" for row in why.candidates)
    clearest = int(np.argmax(found.discs.evidence))
    at = float(found.discs.u[clearest]), float(found.discs.v[clearest])
    why = rd.explain(demo_image, demo_camera, at, polarity="dark")
    assert why.suggestions[0] == "--polarity any finds 1 there."
    assert not any("--radius-m" in words for words in why.suggestions)


@pytest.mark.long
def test_the_right_radius_is_found_at_a_place(
    found: rd.Detection, demo_image: Path, demo_camera: rd.Camera
) -> None:
    clearest = int(np.argmax(found.discs.evidence))
    at = float(found.discs.u[clearest]), float(found.discs.v[clearest])
    why = rd.explain(demo_image, demo_camera, at, radius_m=0.06)
    assert not any(row.is_disc for row in why.candidates)
    assert "the usual votes" in why.place
    (words,) = [words for words in why.suggestions if "--radius-m" in words]
    assert float(words.split()[1]) == pytest.approx(0.10, rel=0.1)


def test_places_where_nothing_can_be_found(
    demo_image: Path, demo_camera: rd.Camera, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Looking for another radius takes long; that it is found is tried above.
    monkeypatch.setattr("detect.explanation._radius_at", lambda *_: None)
    for wrong in ((300.0,), (1, 2, 3), 5, "ab"):
        with pytest.raises(rd.Error, match=r"at is .*: expected a pixel"):
            rd.explain(demo_image, demo_camera, wrong)  # type: ignore[arg-type]
    for at, words in (
        ((300.0, 10.0), "does not see the floor"),
        ((900.0, 100.0), "outside the image"),
        ((377.0, 70.0), "too far"),
        ((3.0, 285.0), "too near to the border"),
        ((3.0, 200.0), " m to the left"),
        ((764.0, 200.0), " m to the right"),
    ):
        why = rd.explain(demo_image, demo_camera, at)
        assert words in why.place, at
