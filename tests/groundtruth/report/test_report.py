"""The report: what a session holds is on the page, what it lacks is said, and nothing can run."""

from __future__ import annotations

import base64
import json
import math
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from redetect.groundtruth.cli import main
from redetect.groundtruth.errors import GroundTruthError
from redetect.groundtruth.report.inputs import Inputs, gather
from redetect.groundtruth.report.page import report_page, table
from redetect.groundtruth.report.pictures import (
    Series,
    Track,
    ellipse_figure,
    ellipses,
    map_figure,
    series_figure,
)
from redetect.groundtruth.trajectories.streams import PlanarPoses, write_planar_poses
from redetect.reporting.page import Part, Section, page_of
from tests.groundtruth.comparison import compare_streams
from tools.simulator.laser.session_files import write_building

HOSTILE = "\"><script>alert(1)</script><img src=x onerror=alert(2)>\x00\ud800 </style> & 'onload="
NAMES = """html head meta title style body a header nav ul li main section h1 h2 p div table caption
thead tbody tr th td figure figcaption img"""
KNOWN = set(NAMES.split())
VOID = {"meta", "img", "link", "br", "input"}


class Page(HTMLParser):
    """Elements, attributes and text of a page, as a browser would take them."""

    def __init__(self, page: bytes) -> None:
        super().__init__(convert_charrefs=True)
        self.tags: list[str] = []
        self.attributes: list[tuple[str, str, str]] = []
        self.words: list[str] = []
        self.open: list[str] = []
        self.feed(page.decode("utf-8"))
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += [(tag, name, value or "") for name, value in attrs]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())


def assert_harmless(page: Page) -> None:
    assert not page.open
    assert not set(page.tags) & {"script", "iframe", "object", "embed", "form", "base", "link"}
    for tag, name, value in page.attributes:
        assert not name.startswith("on"), (tag, name)
        if name in ("src", "href"):
            assert value.startswith(
                ("#", "data:image/png;base64,", "data:image/svg+xml;base64,")
            ), (tag, value)
        if name == "style":
            raise AssertionError(tag)


def drawn(part: Part) -> str:
    """The SVG of a figure."""
    return base64.b64decode(part.address.partition(",")[2]).decode("utf-8")


def stream(offset: float, seed: int, covariance: bool = True) -> PlanarPoses:
    """Two visits of a robot on a circle, with noise of known size."""
    times = np.concatenate([np.arange(0.0, 20.0, 0.2), np.arange(100.0, 120.0, 0.2)])
    angle = 0.1 * times
    truth = np.column_stack([3 + 2 * np.cos(angle), 3 + 2 * np.sin(angle), angle + np.pi / 2])
    truth[:, 2] = (truth[:, 2] + np.pi) % (2 * np.pi) - np.pi
    sigma = np.array([offset, offset, offset])
    noisy = truth + sigma * np.random.default_rng(seed).normal(size=truth.shape)
    covariances = np.tile(np.diag(sigma**2), (len(times), 1, 1)) if covariance else None
    return PlanarPoses(times, noisy, covariances)


def write_session(place: Path) -> Path:
    folder = place / "a session <b>"
    folder.mkdir()
    walls = np.array([[0, 0, 6, 0], [6, 0, 6, 6], [6, 6, 0, 6], [0, 6, 0, 0]], dtype=float)
    write_building(folder / "building.csv", walls)
    for seed, (name, noise) in enumerate({"laser": 0.003, "camera": 0.05, "fused": 0.002}.items()):
        write_planar_poses(folder / f"{name}.csv", stream(noise, seed))
    write_planar_poses(folder / "truth.csv", stream(0.0, 9, covariance=False))
    return folder


@pytest.fixture
def session(tmp_path: Path) -> Path:
    return write_session(tmp_path)


@pytest.fixture(scope="module")
def unchanged(tmp_path_factory: pytest.TempPathFactory) -> tuple[Inputs, bytes]:
    """What a session holds, and its page."""
    inputs = gather(write_session(tmp_path_factory.mktemp("report")))
    return inputs, report_page(inputs, "1.2.3")


def test_figures_on_the_page_are_those_of_the_streams(unchanged: tuple[Inputs, bytes]) -> None:
    inputs, content = unchanged
    np.testing.assert_allclose(inputs.visits, [(0.0, 19.8), (100.0, 119.8)])
    page = Page(content)
    assert_harmless(page)
    assert inputs.truth is not None
    for name in ("laser", "camera", "fused"):
        score = compare_streams(inputs.streams[name], inputs.truth)
        row = (
            f"{score.poses} {1e3 * score.position_mean_m:.2f} {1e3 * score.position_sigma_m:.2f} "
            f"{1e3 * score.position_rmse_m:.2f} {1e3 * score.position_max_m:.2f} "
            f"{math.degrees(score.angle_mean_rad):+.3f}"
        )
        assert row in page.text
        assert f"{score.normalised_error:.3f} {score.poses}" in page.text
    assert "Ground truth: a session <b>" in page.text
    assert "version 1.2.3" in page.text
    figures = [
        base64.b64decode(value.partition(",")[2]).decode("utf-8")
        for tag, name, value in page.attributes
        if (tag, name) == ("img", "src")
    ]
    assert sum("visit 2: 20 s" in figure for figure in figures) == 2


def test_the_page_can_be_used_with_keyboard_and_without_eyes(
    unchanged: tuple[Inputs, bytes],
) -> None:
    page = Page(unchanged[1])
    ids = [value for _, name, value in page.attributes if name == "id"]
    assert len(ids) == len(set(ids))
    for tag, name, value in page.attributes:
        if name == "href" and tag == "a":
            assert value.removeprefix("#") in ids
        if name == "aria-labelledby":
            assert value in ids
    assert page.tags.count("main") == page.tags.count("h1") == page.tags.count("nav") == 1
    assert ("html", "lang", "en") in page.attributes
    assert page.tags.count("caption") == page.tags.count("table")
    labels = [v for tag, name, v in page.attributes if (tag, name) == ("img", "alt")]
    assert len(labels) == page.tags.count("img") == 7
    assert all(labels)
    assert "@media print" in page.text


def test_hostile_text_from_files_is_only_text(session: Path) -> None:
    (session / "validation").mkdir()
    hostile = {
        "version": HOSTILE, "settings": {HOSTILE: {HOSTILE: HOSTILE}}, "poses": HOSTILE,
        "figures": {"position_mean_m": HOSTILE, "normalised_error": [1], "poses": True,
                    "normalised_band": [2, HOSTILE]},
        "refused": [{"index": HOSTILE, "status": HOSTILE, "reason": HOSTILE}, HOSTILE],
        "rejected": [{"stream": HOSTILE, "time_s": 1e999, "squared_innovation": HOSTILE}, 5],
        "used": {HOSTILE: HOSTILE}, "restarts_s": HOSTILE,
        "slips_s": [[HOSTILE], 3], "odometry_pauses_s": HOSTILE,
        "scanners": [{"name": HOSTILE, "suspect": 1}, None], "sets": {HOSTILE: HOSTILE},
    }  # fmt: skip
    for name in ("fused.json", "laser.json", "aligned.json", "validation/validation.json"):
        (session / name).write_text(json.dumps(hostile))
    segment = {
        "from_s": 0.0, "to_s": 120.0, "reference_s": 0.0, "offset_s": 0.1, "rate": 1.0,
        "angle_rad": 0.0, "sigma_offset_s": None, "sigma_rate": None,
        "turned_rad": 1.0, "status": "ok", "note": HOSTILE,
    }  # fmt: skip
    document = {"segments": [segment], "ptpd": {HOSTILE: HOSTILE}}
    (session / "clock.json").write_text(json.dumps(document))
    (session / "camera.csv").write_text("1,2,<script>alert(1)</script>,4\n")
    (session / "validation" / "errors.png").write_bytes(b"<svg onload=alert(1)>")
    assert main(["report", str(session)]) == 0
    page = Page((session / "report.html").read_bytes())
    assert_harmless(page)
    assert page.text.count("<script>alert(1)</script>") > 10
    assert "\x00" not in page.text
    assert "errors.png: not a PNG" in page.text
    assert set(page.tags) <= KNOWN


def test_hostile_text_in_parts_is_only_text() -> None:
    poses = PlanarPoses(np.arange(2.0), np.array([[0, 0, 0], [4.0, 2, 0]]))
    shown = [
        map_figure(HOSTILE, [Track("a", "red", (), poses)], None),
        series_figure(HOSTILE, "mm", [], []),
        table(HOSTILE, [HOSTILE], [[HOSTILE]]),
        *(Part(kind, HOSTILE) for kind in ("note", "problem", "text", "heading")),
    ]
    text = page_of(HOSTILE, [Section("a", HOSTILE, shown)])
    told = Page(text)
    assert not told.open
    assert set(told.tags) <= KNOWN | {"title", "h3"}
    assert not any(name.startswith("on") for _, name, _ in told.attributes)
    assert told.text.count("<script>alert(1)</script>") >= 8
    assert not set("\x00\x7f") & set(text.decode("utf-8"))


def test_files_larger_than_the_bounds_are_not_read(
    session: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (session / "validation").mkdir()
    (session / "validation" / "errors.png").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(100))
    (session / "laser.json").write_text(json.dumps({"settings": "x" * 100}))
    assert not gather(session).problems
    for module, name in (
        ("report.inputs", "_MOST_PICTURE_BYTES"),
        ("files", "_LARGEST_FILE_BYTES"),
    ):
        monkeypatch.setattr(f"redetect.groundtruth.{module}.{name}", 64)
    inputs = gather(session)
    for place, kind in (
        ("validation/errors.png", "picture"),
        ("laser.json", "file"),
    ):
        assert f"{place}: cannot be read as a {kind}: larger than 64 bytes" in inputs.problems
    assert not inputs.pictures


def test_what_is_missing_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["report", str(tmp_path)]) == 0
    assert "no poses" in capsys.readouterr().out
    page = Page((tmp_path / "report.html").read_bytes())
    assert_harmless(page)
    for name in ("building.csv or building.dxf", "laser.csv", "camera.csv", "fused.csv",
                 "clock.json", "validation/validation.json", "truth.csv"):  # fmt: skip
        assert name in page.text
    assert "nothing to draw" in page.text
    assert main(["report", str(tmp_path)]) == 1
    assert "--force" in capsys.readouterr().err


def test_a_session_of_markers_alone_is_shown(tmp_path: Path) -> None:
    """Cameras' poses have the name that `groundtruth poses` gives them by default."""
    write_planar_poses(tmp_path / "truth.csv", stream(0.0, 9, covariance=False))
    assert "No poses to compare" in Page(report_page(gather(tmp_path), "1")).text
    write_planar_poses(tmp_path / "poses.csv", stream(0.05, 1))
    outcome = {"times": {"clear": 198, "failed": 2}, "reduced_cost": 1.02}
    (tmp_path / "poses.json").write_text(json.dumps(outcome))
    inputs = gather(tmp_path)
    assert "camera.csv" not in inputs.missing
    page = Page(report_page(inputs, "1"))
    assert "cameras 200 " in page.text
    assert "Times of images: 198 clear, 2 failed; squared residuals" in page.text
    assert "No values to show" not in page.text


def test_what_cannot_be_read_is_said_and_the_rest_is_shown(
    session: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (session / "laser.csv").write_text("1,2,three,4\n")
    (session / "fused.json").write_text("[" * 100_000)
    (session / "laser.json").write_text("[1]")
    (session / "clock.json").write_text('{"segments": []}')
    (session / "building.csv").write_text("1,2,3\n")
    output = session / "page.html"
    assert main(["report", str(session), "-o", str(output)]) == 0
    page = Page(output.read_bytes())
    assert_harmless(page)
    warnings = capsys.readouterr().err
    for words in ("laser.csv:1: 'three'", "fused.json: invalid JSON", "laser.json: expected a JSON",
                  "clock.json: segm", "building.csv:1:"):  # fmt: skip
        assert words in page.text
        assert words in warnings
    assert "cameras" in page.text
    with pytest.raises(GroundTruthError, match="no such folder"):
        gather(session / "nothing")
    assert main(["report", str(session), "--truth", str(session / "none.csv"), "--force"]) == 1


def test_numbers_that_no_double_holds_are_survived(session: Path) -> None:
    steps = {"merged": [[10**400, 0, 0]], "each to the map": [[0, 0, 0]]}
    aligned = {"scanners": [{"name": "a"}], "steps": steps}
    (session / "aligned.json").write_text(json.dumps(aligned))
    page = Page(report_page(gather(session), "1.2.3"))
    assert "after each step" not in page.text


def test_the_same_session_gives_the_same_page(
    session: Path, unchanged: tuple[Inputs, bytes]
) -> None:
    assert report_page(gather(session), "1.2.3") == unchanged[1]


def test_slips_and_pauses_of_odometry_are_said(session: Path) -> None:
    fused = {
        "slips_s": [[20.0, 21.5]],
        "odometry_pauses_s": [[1.0, 4.0], [7.0, 9.0]],
        "odometry_resets_s": [[12.0, 12.02]],
    }
    (session / "fused.json").write_text(json.dumps(fused))
    assert main(["report", str(session)]) == 0
    text = Page((session / "report.html").read_bytes()).text
    assert "slip of the wheels, 1 times (s): 20.000 to 21.500." in text
    assert "pauses, 2 times (s): 1.000 to 4.000; 7.000 to 9.000." in text
    assert "steps that no robot can make, 1 times (s): 12.000 to 12.020." in text


def test_streams_without_covariances_or_truth_in_common(session: Path) -> None:
    write_planar_poses(session / "laser.csv", stream(0.01, 3, covariance=False), overwrite=True)
    late = stream(0.0, 4)
    late = PlanarPoses(late.times_s + 1e4, late.poses)
    write_planar_poses(session / "truth.csv", late, overwrite=True)
    page = Page(report_page(gather(session), "1"))
    assert "laser: no covariances, no ellipses" in page.text
    assert "no times in common with the truth" in page.text
    assert_harmless(page)


def test_streams_of_other_times_and_many_visits_are_survived(session: Path) -> None:
    fused = stream(0.001, 5)
    elsewhere = PlanarPoses(fused.times_s + 1e5, fused.poses, fused.covariances)
    write_planar_poses(session / "fused.csv", elsewhere, overwrite=True)
    write_planar_poses(session / "odometry.csv", elsewhere)
    inputs = gather(session)
    assert inputs.odometry is None
    page = Page(report_page(inputs, "1"))
    assert "fused: 0 poses and" in page.text
    assert "fused, pauses included: no times in common with the truth" in page.text
    assert_harmless(page)
    times = np.repeat(np.arange(400.0) * 60.0, 3) + np.tile([0.0, 0.1, 0.2], 400)
    many = PlanarPoses(times, np.zeros((1200, 3)), np.zeros((1200, 3, 3)))
    for name in ("laser", "truth"):
        write_planar_poses(session / f"{name}.csv", many, overwrite=True)
    (session / "camera.csv").unlink()
    inputs = gather(session)
    assert len(inputs.visits) == 400
    series = Series("a", "red", (), times, np.ones(1200))
    assert "visit " in drawn(series_figure("s", "mm", [series], inputs.visits))
    assert "No values to show" in series_figure("s", "mm", [], inputs.visits).words
    assert "400 visits" in Page(report_page(inputs, "1")).text


def test_odometry_is_brought_to_the_truth(session: Path) -> None:
    truth = gather(session).truth
    assert truth is not None
    c, s = math.cos(1.0), math.sin(1.0)
    moved = truth.poses @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + [5.0, -7.0, 1.0]
    write_planar_poses(session / "odometry.csv", PlanarPoses(truth.times_s + 0.4, moved))
    segment = {
        "from_s": 0.0, "to_s": 120.0, "reference_s": 0.0, "offset_s": 0.4, "rate": 1.0,
        "angle_rad": 0.0, "sigma_offset_s": 1e-3, "sigma_rate": 1e-6,
        "turned_rad": 1.0, "status": "ok", "note": "",
    }  # fmt: skip
    (session / "clock.json").write_text(json.dumps({"segments": [segment]}))
    odometry = gather(session).odometry
    assert odometry is not None
    assert compare_streams(odometry, truth).position_max_m < 1e-5


def test_ellipses_are_three_sigma() -> None:
    turn = np.array([[math.cos(0.5), -math.sin(0.5)], [math.sin(0.5), math.cos(0.5)]])
    covariance = np.zeros((2, 3, 3))
    covariance[:, :2, :2] = turn @ np.diag([0.09, 0.01]) @ turn.T
    poses = PlanarPoses(np.arange(2.0), np.array([[0, 0, 0], [4.0, 2, 0]]), covariance)
    outlines, factor = ellipses(poses, 0.2, 2)
    assert factor == 1.0
    for outline, centre in zip(outlines, poses.poses[:, :2]):
        apart = (outline - centre) @ turn
        np.testing.assert_allclose((apart / [0.9, 0.3]) ** 2 @ [1.0, 1.0], 1.0)
    small = PlanarPoses(poses.times_s, poses.poses, covariance / 1e4)
    outlines, factor = ellipses(small, 1.0, 2)
    assert factor in (10.0, 20.0)
    apart = (outlines[0] - small.poses[0, :2]) @ turn
    assert np.abs(apart[:, 0]).max() == pytest.approx(0.009 * factor, rel=0.01)
    part = ellipse_figure(Track("a", "red", (), small), None, 2)
    assert "magnified" in part.words


@pytest.mark.parametrize(("nees", "marked"), [(1.05, False), (2.5, True)])
def test_a_normalised_error_outside_its_band_is_marked(nees: float, marked: bool) -> None:
    figures = {"normalised_error": nees, "normalised_band": [0.8, 1.2], "poses": 23}
    inputs = Inputs("s", documents={"validation.json": {"figures": figures}})
    assert ('class="problem">23 reference poses' in report_page(inputs, "1").decode()) == marked


def test_covariances_that_are_too_small_are_marked(session: Path) -> None:
    laser = stream(0.003, 0)
    assert laser.covariances is not None
    small = PlanarPoses(laser.times_s, laser.poses, laser.covariances / 4.0)
    write_planar_poses(session / "laser.csv", small, overwrite=True)
    page = report_page(gather(session), "1").decode()
    assert len(re.findall(r'<td class="marked">[34]\.\d{3}</td>', page)) == 1
    assert page.count('class="marked"') == 1


def test_settings_are_a_list_of_rounded_numbers() -> None:
    document = {"version": "1", "settings": {"rms_s": 0.0008657632668993772, "count": 3}}
    page = report_page(Inputs("s", documents={"clock.json": document}), "1").decode()
    assert "<li>rms_s: 0.000865763</li><li>count: 3</li>" in page


def test_what_was_measured_in_the_building_and_on_board_is_shown(session: Path) -> None:
    (session / "dimensions.csv").write_text("room,0,0,3,4,5.01\nwall,0,0,0,2,1.998\n")
    places = {"A": [0, 0], "B": [3, 0], "C": [3, 4]}
    survey = {"version": 1, "sigma_m": 0.005, "fiducials": places, "robot_points": places}
    (session / "fiducials.json").write_text(json.dumps(survey))
    (session / "fiducial_distances.csv").write_text("A,B,3.0\nB,C,4.0\nA,C,5.0\n")
    square = np.array([[0, 0, 0], [4, 0, 1], [4, 3, 2.0]])
    turned = square @ np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]]) + [5, 5, 0]
    aligned = {
        "scanners": [{"name": name} for name in "abc"],
        "steps": {"pairs": turned.tolist(), "each to the map": square.tolist()},
    }
    (session / "aligned.json").write_text(json.dumps(aligned))
    bins = [{"from_deg": 0, "to_deg": 15, "readings": 7, "mean_m": 0.0012, "sigma_m": 0.0034}]
    mount = {"name": "front", "given": [0.36, 0, 0], "refined": [0.361, 0.002, 0.001],
             "sigma": [0.0004, 0.0005, 0.0006]}  # fmt: skip
    (session / "validation").mkdir()
    document = {"figures": {}, "incidence": bins, "mounts": [mount, {"name": "odd"}, 5]}
    (session / "validation" / "validation.json").write_text(json.dumps(document))
    write_planar_poses(session / "filtered.csv", stream(0.004, 7))
    inputs = gather(session)
    assert not inputs.problems
    page = Page(report_page(inputs, "1"))
    assert_harmless(page)
    for words in (
        "room 5.000 5.010 -10.0 wall 2.000 1.998 +2.0",
        "2 dimensions: mean -4.0 mm, sigma 8.5 mm, worst 10.0 mm",
        "3 distances, rms residual 0.0 mm",
        "pairs 0.0 0.0 0.0 each to the map 0.0 0.0 0.0",  # moved as a whole alone
        "0 to 15 7 1.20 3.40",
        "front 360.0 0.0 0.000 1.0 2.0 0.057 0.4 0.5 0.034",
        "filter alone 200",
        "Visit 1: laser, cameras, filter alone, fused; grey: fused.",
    ):
        assert words in page.text, words
