"""The report's figures against truth made by hand, and its page: self-contained and escaped."""

from __future__ import annotations

import re
import shutil
from collections.abc import Generator, Sequence
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from camera import camera_in
from detect.cli import main
from detect.comparison.compare import compare_frames, compare_line_frames
from detect.comparison.result import DiscComparison, LineComparison
from detect.options import CompareOptions, RowFiles
from detect.projection import DiscProjection
from detect.report.figures import binned, rates_over, repeated, whitened
from detect.report.page import gather, report_page
from detect.row_files import ImageRows
from detect.sources.interface import RunFrame, SomeFrames
from detect.sources.opening import open_source
from redetect.landmarks import (
    CircleLandmark,
    Frame,
    Landmark,
    LineLandmark,
    Step,
    circle_landmarks,
    read_frames,
)
from tests.detect.commands import Captured, assert_refused, in_browser

GATE = CompareOptions(gate_m=0.1)
Discs = list[tuple[list[CircleLandmark], list[CircleLandmark]]]
Lines = list[tuple[list[LineLandmark], list[LineLandmark]]]


def disc(x: float, y: float, quality: float = 0.9) -> CircleLandmark:
    return CircleLandmark(x, y, quality, 4e-4, 1e-4, 9e-4, (-1,))


def line(alpha: float, sigma: float) -> LineLandmark:
    return LineLandmark(0.0, -0.5, 0.0, 0.2, alpha, 0.0, 0.0, sigma, (-1,))


def frames(
    pairs: Sequence[tuple[Sequence[Landmark], Sequence[Landmark]]], side: int
) -> list[Frame]:
    return [Frame(Step(f"e.{k}", *[0.0] * 9), tuple(pair[side])) for k, pair in enumerate(pairs)]


def compared(pairs: Discs, options: CompareOptions = GATE) -> DiscComparison:
    """Discs of frames: reference and detected rows of each."""
    return compare_frames(frames(pairs, 0), frames(pairs, 1), options)


def compared_lines(pairs: Lines) -> LineComparison:
    return compare_line_frames(frames(pairs, 0), frames(pairs, 1))


# -- rates over thresholds --------------------------------------------------------------------


def test_rates_of_a_case_made_by_hand() -> None:
    discs = [
        # Both rows fit the first disc; the nearer one takes it.
        (
            [disc(0.0, -1.0), disc(1.0, -1.0)],
            [disc(0.01, -1.0, 0.5), disc(0.05, -1.0, 0.8), disc(2.0, -2.0, 0.7)],
        ),
        ([disc(0.0, -3.0)], [disc(0.0, -3.02, 0.95)]),
        ([], [disc(0.5, -1.5, 0.6)]),
    ]
    recall, precision = rates_over(compared(discs), [0.4, 0.55, 0.65, 0.75, 0.9, 0.99])
    np.testing.assert_allclose(recall, [2 / 3, 1 / 3, 1 / 3, 1 / 3, 1 / 3, 0.0])
    np.testing.assert_allclose(precision, [2 / 5, 1 / 4, 1 / 3, 1 / 2, 1.0, np.nan])


def test_rows_set_aside_are_not_kept() -> None:
    """At the least threshold, the rates are those of the comparison."""
    discs: Discs = [([disc(0.0, -1.0)], [disc(0.0, -1.0, 0.5), disc(1.0, -2.0, 0.8)])]
    unlisted = (Frame(Step("e.0", *[0.0] * 9), (disc(1.0, -2.0),)),)
    result = compare_frames(frames(discs, 0), frames(discs, 1), GATE, unlisted=unlisted)
    _, precision = rates_over(result, [0.4, 0.7])
    np.testing.assert_allclose(precision, [1.0, np.nan])


def test_without_rows_there_are_no_rates() -> None:
    recall, precision = rates_over(compared([([], [])]), [0.5])
    assert np.isnan(recall).all()
    assert np.isnan(precision).all()


# -- residuals --------------------------------------------------------------------------------


def test_whitened_residuals_are_the_mahalanobis_distance() -> None:
    residuals = whitened(compared([([disc(0.3, -1.0)], [disc(0.32, -1.05)])]))
    covariance = np.array([[4e-4, 1e-4], [1e-4, 9e-4]])
    offset = np.array([0.02, -0.05])
    np.testing.assert_allclose((residuals**2).sum(), offset @ np.linalg.solve(covariance, offset))


def test_errors_drawn_from_the_covariance_are_standard_normal() -> None:
    rng = np.random.default_rng(5)
    factor = np.linalg.cholesky(np.array([[4e-4, 1e-4], [1e-4, 9e-4]]))
    discs = []
    for _ in range(2000):
        dx, dy = factor @ rng.standard_normal(2)
        discs.append(([disc(0.0, -2.0)], [disc(dx, -2.0 + dy)]))
    residuals = whitened(compared(discs, CompareOptions(gate_m=1.0)))
    assert len(residuals) == 4000
    # Four standard deviations of these figures.
    assert abs(residuals.mean()) < 4.0 / np.sqrt(4000)
    assert abs(residuals.std() - 1.0) < 4.0 / np.sqrt(8000)
    within = [np.mean(np.abs(residuals) <= k) for k in (1, 2, 3)]
    assert within == pytest.approx([0.683, 0.954, 0.997], abs=0.03)


def test_residuals_of_bearings_are_wrapped_and_need_a_sigma() -> None:
    lines = [([line(3.141, 0.01)], [line(-3.141, 0.002)]), ([line(0.1, 0.01)], [line(0.101, 0.0)])]
    result = compared_lines(lines)
    np.testing.assert_allclose(result.pairs.error_rad, [2 * np.pi - 6.282, 0.001], atol=1e-12)
    np.testing.assert_allclose(whitened(result), [(2 * np.pi - 6.282) / 0.002])
    assert not len(whitened(compared_lines([([], [])])))


def test_bins_are_of_equally_many() -> None:
    at = np.arange(80.0)
    centre, median, p95 = binned(at, 2.0 * at)
    assert len(centre) == 10
    np.testing.assert_allclose(median, 2.0 * centre)
    np.testing.assert_allclose(
        p95, [np.quantile(2.0 * at[k : k + 8], 0.95) for k in range(0, 80, 8)]
    )
    assert len(binned(np.zeros(0), np.zeros(0))[0]) == 0


# -- the page ---------------------------------------------------------------------------------


class Page(HTMLParser):
    """What a browser would make of a page: its elements, balanced."""

    VOID = ("meta", "img", "br", "link")

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self._open: list[str] = []
        self.feed(text)
        self.close()
        assert self._open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self._open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words.append(data)

    def of(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.elements if name == tag]


def assert_self_contained(page: Page, text: str) -> None:
    assert not {tag for tag, _ in page.elements} & {"script", "link", "iframe", "object", "form"}
    for _, attributes in page.elements:
        assert not any(name.startswith("on") for name in attributes)
    for image in page.of("img"):
        assert (image["src"] or "").startswith("data:image/")
        assert image["alt"]
    assert "url(" not in text
    links = {attributes["href"] for attributes in page.of("a")}
    ids = {attributes["id"] for _, attributes in page.elements if "id" in attributes}
    assert all((link or "").removeprefix("#") in ids for link in links)
    # What scrolls by itself can be reached by keyboard.
    for attributes in page.of("div"):
        if attributes.get("class") == "wide":
            assert attributes["tabindex"] == "0"
            assert attributes["aria-label"]


def reported(small_run: Path, page: Path, *flags: str) -> Page:
    assert main(["report", str(small_run), "-o", str(page), *flags]) == 0
    text = page.read_text()
    parsed = Page(text)
    assert_self_contained(parsed, text)
    return parsed


@pytest.fixture
def judged_run(small_run: Path) -> Path:
    """The small run with everything detected, and reference rows of which one is not seen."""
    assert main(["all", str(small_run)]) == 0
    (small_run / "map.circles").write_text(
        "STEP s.0000 0 0 0 0 0 0 0 0 0\n"
        "LANDMARK_C 0.1 -1.2 0.9 1e-4 0 1e-4 1\nLANDMARK_C -0.5 -1.9 0.9 1e-4 0 1e-4 2\n"
        "STEP s.0001 0 0 0 0 0 0 0 0 0\nLANDMARK_C 1.0 -1.5 0.9 1e-4 0 1e-4 3\n"
    )
    return small_run


@pytest.mark.lowest
def test_page_states_what_comparing_does(judged_run: Path, tmp_path: Path) -> None:
    page = reported(judged_run, tmp_path / "r.html")
    words = " ".join(" ".join(page.words).split())
    camera = camera_in(judged_run)
    assert camera is not None
    reference, found = (read_frames(judged_run / f"{name}.circles") for name in ("map", "detected"))
    expected = compare_frames(reference, found, projection=DiscProjection(camera))
    assert (expected.matched, expected.missed, expected.extra) == (2, 1, 1)
    assert f"recall {expected.recall:.4g}" in words
    assert f"precision {expected.precision:.4g}" in words
    assert "2 of 3 discs of the reference are found, 1 missed" in words
    assert "extra 1" in words
    assert "s.0001 0 1 1 -" in words
    assert "radius_m 0.1" in words
    first = (tmp_path / "r.html").read_bytes()
    reported(judged_run, tmp_path / "r.html", "--force")
    assert (tmp_path / "r.html").read_bytes() == first


def test_unlisted_verticals_are_no_errors(project_root: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    run.mkdir()
    demo = project_root / "images" / "e"
    for name in ("e.cam", "e.txt", "map.lines"):
        shutil.copy(demo / name, run)
    (run / "images").symlink_to(demo / "images")
    listed = (run / "map.lines").read_text().splitlines()
    (run / "detected.lines").write_text("\n".join(listed) + "\n")
    wanted = [row for k, row in enumerate(listed) if k % 3 or not row.startswith("LANDMARK")]
    (run / "map.lines").write_text("\n".join(wanted) + "\n")

    without = " ".join(reported(run, tmp_path / "without.html").words)
    (run / "unlisted.lines").write_text("\n".join(listed) + "\n")
    words = " ".join(reported(run, tmp_path / "with.html").words)

    assert re.search(r"precision\s+0\.[67]", without)
    assert re.search(r"precision\s+1\s", words)
    assert re.search(r"verticals set aside\s+[1-9]", words)


def test_steps_too_long_for_a_map(judged_run: Path, tmp_path: Path) -> None:
    path = judged_run / "detected.circles"
    path.write_text(re.sub(r"(?m)^(STEP \S+) +\S+", r"\1 1e23", path.read_text()))
    words = " ".join(" ".join(reported(judged_run, tmp_path / "r.html").words).split())
    assert "No map of the floor: positions above 1e+12 m." in words


def test_names_with_two_extensions(judged_run: Path, tmp_path: Path) -> None:
    for name in ("map.circles", "detected.circles", "s.txt"):
        path = judged_run / name
        path.write_text(re.sub(r"(?m)^STEP (s\.000.)", r"STEP \1.png.png", path.read_text()))
    page = reported(judged_run, tmp_path / "r.html")
    assert "Frame s.0001.png (number 1 of discs)" in " ".join(" ".join(page.words).split())


def test_page_without_reference_shows_some_frames(small_run: Path, tmp_path: Path) -> None:
    assert main(["circles", str(small_run), "--threshold", "0.4"]) == 0
    page = reported(small_run, tmp_path / "r.html")
    words = " ".join(" ".join(page.words).split())
    assert "No reference rows" in words
    assert "Discs against the reference" not in words
    assert "Frame s.0002 (no reference rows)" in words
    assert "threshold 0.4" in words


def test_what_a_run_without_truth_lacks(small_run: Path, tmp_path: Path) -> None:
    """Steps of zeros, tilts, frames without rows in any file; no path then."""
    step, row = "0 0 0 0 0 0 0 0 0\n", "LANDMARK_C 0.1 -1.2 0.9 1e-4 0 1e-4 -1\n"
    found = f"STEP s.0000 {step}{row}STEP s.0002 {step}"
    (small_run / "detected.circles").write_text(found)
    tilts = "TILT s.0000 0.01 0.02 1e-6 0 1e-6 9\nTILT s.0002 0.01 0.02 1e-6 0 1e-6 1\n"
    (small_run / "detected.tilt").write_text(tilts)
    words = " ".join(" ".join(reported(small_run, tmp_path / "r.html").words).split())
    assert "not processed 1 " in words
    assert "1 frame not processed: no file has rows of them." in words
    assert "No odometry: the steps are zeros." in words
    assert "as seen from the robot" in words
    assert "along the path" not in words
    assert "Repeatability" not in words
    assert "Too few agree in s.0002." in words


def test_repeatability_is_that_of_the_rows() -> None:
    """The step's error, common to all discs of two frames, is not attributed to the rows."""
    rng = np.random.default_rng(3)
    sigma, step_sigma = np.array([0.002, 0.005]), np.array([0.02, 0.02, 0.01])
    variances = (step_sigma**2).tolist()
    spread = (variances[0], 0.0, variances[1], 0.0, 0.0, variances[2])
    xy = np.array([[x, y] for x in (-1.0, 0.0, 1.0) for y in (-4.0, -3.0, -2.0)])
    rows = []
    for k in range(200):
        discs = xy + sigma * rng.standard_normal(xy.shape)
        step = Step(f"s.{k}", *[*(step_sigma * rng.standard_normal(3)).tolist(), *spread])
        covariance = np.tile(np.diag(sigma**2), (len(xy), 1, 1))
        landmarks = circle_landmarks(discs, np.full(len(xy), 0.9), covariance)
        rows.append(ImageRows(circles=Frame(step, landmarks)))
    found = repeated(rows)
    assert found is not None
    pairs, rms_m, stated_m, per_dof = found
    assert pairs == 199 * len(xy)
    assert per_dof == pytest.approx(1.0, abs=0.06)
    assert rms_m == pytest.approx(stated_m, rel=0.05)
    assert repeated([replace(row, circles=None) for row in rows]) is None
    # Unknown ones are zero.
    for variance in (0.0, -1e-2, -2e-4, 1e6):
        other = replace(step, cxx=variance, cyy=variance, cphiphi=max(variance, 0.0))
        spoilt = replace(rows[2], circles=Frame(other, landmarks))
        assert repeated([spoilt, spoilt]) is None
        assert repeated([*rows[:2], spoilt]) == repeated(rows[:2])


def test_a_source_is_read_twice_however_many_frames_are_shown(judged_run: Path) -> None:
    """A video is decoded each time."""
    passes = []

    class Counted(SomeFrames):
        def __iter__(self) -> Generator[RunFrame, None, None]:
            passes.append(1)
            return super().__iter__()

    run = open_source(judged_run)
    inputs = gather(replace(run, frames=Counted(run.frames)), RowFiles())
    assert report_page(inputs, 3).count(b"data:image/jpeg") == 2
    assert len(passes) == 2


def test_page_of_one_frame_has_no_empty_figure(judged_run: Path, tmp_path: Path) -> None:
    """Nothing is drawn over frames, or over thresholds that are all the same."""
    for name in ("s.0001.png", "s.0002.png"):
        (judged_run / "images" / name).unlink()
    steps = (judged_run / "s.txt").read_text().splitlines(keepends=True)
    (judged_run / "s.txt").write_text("".join(steps[:2]))
    for ending in ("lines", "tilt"):
        (judged_run / f"detected.{ending}").write_text("STEP s.0000 0 0 0 0 0 0 0 0 0\n")
    (judged_run / "detected.tilt").write_text("TILT s.0000 0.01 0.02 1e-6 0 1e-6 9\n")
    (judged_run / "detected.circles").write_text(
        "STEP s.0000 0 0 0 0 0 0 0 0 0\nLANDMARK_C 0.1 -1.2 0.9 1e-4 0 1e-4 1\n"
    )
    page = reported(judged_run, tmp_path / "r.html")
    figures = [image["alt"] or "" for image in page.of("img")]
    assert [words.split(",")[0].split(" (")[0] for words in figures] == [
        "Frame s.0000",
        "Positions of the same disc on the floor",
        "Residuals in units of the covariance that the rows state",
    ]
    words = " ".join(" ".join(page.words).split())
    assert "1 of 1 frame; 9 verticals agree" in words


HOSTILE = "<script>document.title='in'</script><img/src=x/onerror=alert(2)>\"'&amp;{{7*7}}"


@pytest.fixture
def hostile_run(small_run: Path, tmp_path: Path) -> tuple[Path, str]:
    """A run whose every name and line is hostile, and its frame's name."""
    name = HOSTILE.replace("/", "")
    step = f"STEP {name} 0 0 0 0 0 0 0 0 0\n"
    (small_run / "s.txt").write_bytes(step.encode() + b"STEP x\xff\x01y 0 0 0 0 0 0 0 0 0\n")
    row = "LANDMARK_C 0.1 -1.2 0.9 1e-4 0 1e-4 1\n"
    head = f"# </style>{HOSTILE}\n# settings radius_m=0.1 {HOSTILE}={HOSTILE}\n"
    (small_run / "detected.circles").write_text(head + step + row)
    (small_run / "map.circles").write_text(step + row + row.replace("0.1", "0.9"))
    # An image of such a name, so that it is in captions and alternative texts as well.
    shutil.copy(small_run / "images" / "s.0000.png", small_run / "images" / f"{name}.png")
    return Path(shutil.copytree(small_run, tmp_path / "<b>&run")), name


def test_everything_from_files_is_escaped(hostile_run: tuple[Path, str], tmp_path: Path) -> None:
    folder, name = hostile_run
    page = reported(folder, tmp_path / "r.html")
    assert not page.of("b")
    words = " ".join(page.words)
    assert "<b>&run" in words
    assert f"Frame {name} (most discs, number 1 of discs)" in words
    assert any(name in (image["alt"] or "") for image in page.of("img"))
    assert f"</style>{HOSTILE}" in words
    assert "49" not in re.findall(r"\{*49\}*", words)
    assert not re.search(r"[\x00-\x08\x0b-\x1f\x7f]", words)


@pytest.mark.long
def test_nothing_of_a_file_is_executed(hostile_run: tuple[Path, str], tmp_path: Path) -> None:
    """Not even if the browser took no notice of the page's own prohibition of scripts."""
    reported(hostile_run[0], tmp_path / "r.html")
    text = (tmp_path / "r.html").read_text()
    prohibition = re.compile(r'<meta http-equiv="Content-Security-Policy"[^>]*>')
    (tmp_path / "r.html").write_text(prohibition.sub("", text))
    shown, _ = in_browser((tmp_path / "r.html").as_uri(), tmp_path / "profile")
    assert "<title>Detections of &lt;b&gt;&amp;run</title>" in shown
    # The same words as they are would be.
    (tmp_path / "x.html").write_text(f"<!DOCTYPE html><title>not in</title>{HOSTILE}")
    shown, _ = in_browser((tmp_path / "x.html").as_uri(), tmp_path / "profile")
    assert "<title>in</title>" in shown


def test_refusals(judged_run: Path, tmp_path: Path, capsys: Captured) -> None:
    run, page = str(judged_run), tmp_path / "r.html"
    report = ["report", run, "-o", str(page)]
    capsys.readouterr()
    with pytest.raises(SystemExit):
        main([*report, "--worst", "-1"])
    assert "worst is -1: expected a whole number" in capsys.readouterr().err
    assert_refused([*report, "--reference", "no.circles"], judged_run, "no.circles", capsys)
    assert_refused([*report, "--rows", str(tmp_path)], judged_run, "detect all", capsys)
    page.write_bytes(b"mine")
    assert_refused(report, judged_run, "--force", capsys)
    assert page.read_bytes() == b"mine"
    (judged_run / "detected.circles").write_text("STEP s.0000 0\n")
    assert_refused([*report, "--force"], judged_run, "detected.circles", capsys)
    assert page.read_bytes() == b"mine"
