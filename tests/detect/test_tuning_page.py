"""The page for turning knobs: what it shows is what is detected, and only its owner gets it."""

from __future__ import annotations

import http.client
import json
import math
import re
import threading
from collections.abc import Iterator
from dataclasses import asdict, replace
from importlib.resources import files
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest

from camera import Camera, read_camera
from detect.cli import main
from detect.errors import DetectError
from detect.explanation import Stage
from detect.settings import CircleSettings
from detect.settings_files import read_settings
from detect.sources.opening import open_run
from detect.tuning_page import TuningServer, TuningSession, serve
from redetect.landmarks import read_frames
from tests.detect.commands import in_browser

FRAMES = 3


@pytest.fixture
def server(project_root: Path, tmp_path: Path) -> Iterator[TuningServer]:
    run = open_run(project_root / "images" / "e")
    frames = [frame for frame, _ in zip(run.frames, range(FRAMES))]
    session = TuningSession(run, frames, CircleSettings(polarity="light"), tmp_path / "tuned")
    with TuningServer(session) as served:
        thread = threading.Thread(target=served.serve_forever)
        thread.start()
        yield served
        served.shutdown()
        thread.join()


def test_the_page_knows_the_stages() -> None:
    page = files("detect").joinpath("tuning_page.html").read_text("utf-8")
    named = re.findall(r'\.stage [!=]== "([^"]+)"', page)
    assert named
    assert set(named) <= set(get_args(Stage))


def ask(
    server: TuningServer, method: str, path: str, content: Any = None, **headers: str
) -> tuple[int, bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=60)
    try:
        body = None if content is None else json.dumps(content)
        connection.request(method, path, body, headers)
        answer = connection.getresponse()
        return answer.status, answer.read()
    finally:
        connection.close()


def post(server: TuningServer, path: str, content: Any) -> tuple[int, Any]:
    status, answer = ask(server, "POST", path, content, **{"X-Token": server.token})
    return status, json.loads(answer)


def test_page_and_images_come_with_the_token(server: TuningServer) -> None:
    status, page = ask(server, "GET", f"/?token={server.token}")
    assert status == 200
    assert b"Tuning" in page
    assert b"@RUN@" not in page
    assert b'"polarity": "light"' in page
    status, image = ask(server, "GET", f"/frame/0?token={server.token}")
    assert status == 200
    assert image.startswith(b"\x89PNG")


@pytest.mark.parametrize(
    "path", ["/", "/?token=", "/?token=x", "/frame/0", "/frame/0?token=%C3%A9"]
)
def test_nothing_comes_without_it(server: TuningServer, path: str) -> None:
    status, answer = ask(server, "GET", path)
    assert status == 403
    assert b"e.0000" not in answer
    assert ask(server, "POST", "/detect", {"frame": 0, "settings": {}})[0] == 403


def test_another_name_of_this_machine_is_refused(server: TuningServer) -> None:
    """A page of somebody else's can let its own name point here, and would be taken for this."""
    status, _ = ask(
        server, "GET", f"/?token={server.token}", Host=f"evil.example:{server.server_port}"
    )
    assert status == 403


def test_detects_as_the_command_does(
    server: TuningServer, project_root: Path, tmp_path: Path
) -> None:
    status, found = post(server, "/detect", {"frame": 1, "settings": {"threshold": 0.6}})
    assert status == 200
    rows = tmp_path / "rows.circles"
    run = str(project_root / "images" / "e")
    assert main(["circles", run, "--frames", "2", "--threshold", "0.6", "-o", str(rows)]) == 0
    frame = list(read_frames(rows))[1]
    assert [(d["x"], d["y"]) for d in found["discs"]] == [
        pytest.approx((row.px, row.py), abs=1e-5) for row in frame.circles
    ]
    np.testing.assert_allclose(
        [d["covariance"] for d in found["discs"]],
        [(row.cxx, row.cxy, row.cyy) for row in frame.circles],
        rtol=1e-4,
    )
    assert len(found["discs"]) >= 5
    assert all(one["reason"] for one in found["rejected"])
    # Outlines and ellipses are round the discs.
    camera = read_camera(project_root / "images" / "e" / "e.cam")
    for disc in found["discs"]:
        u, v = camera.project_floor([disc["x"], disc["y"]])
        outline = np.array(disc["outline"])
        assert outline[:, 0].min() < u < outline[:, 0].max()
        assert outline[:, 1].min() < v < outline[:, 1].max()
        np.testing.assert_allclose(np.mean(disc["ellipse"], axis=0), [disc["x"], disc["y"]])


def test_covariances_are_those_of_a_calibration_that_states_none(
    project_root: Path, published_camera: Camera, tmp_path: Path
) -> None:
    run = replace(open_run(project_root / "images" / "e"), camera=published_camera)
    frames = [frame for frame, _ in zip(run.frames, range(1))]
    session = TuningSession(run, frames, CircleSettings(), tmp_path)
    stated, doubted = (
        np.array([d["covariance"] for d in session.detect(0, {"calibration_px": px})["discs"]])
        for px in (0.0, 0.15)
    )
    assert np.all(doubted[:, [0, 2]] > stated[:, [0, 2]])


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"radius_m": -1.0}, "radius_m"),
        ({"radius_m": "a"}, "radius_m"),
        ({"radius": 0.1}, "radius is not a parameter"),
        ({"samples": True}, "samples"),
    ],
)
def test_impossible_settings_are_refused_in_words(
    server: TuningServer, settings: dict[str, Any], words: str
) -> None:
    status, answer = post(server, "/detect", {"frame": 0, "settings": settings})
    assert status == 422
    assert words in answer["error"]


@pytest.mark.parametrize(
    "content",
    [{}, [], {"frame": 99, "settings": {}}, {"frame": "x", "settings": {}}, 7, {"frame": math.inf}],
)
def test_nonsense_is_refused(server: TuningServer, content: Any) -> None:
    status, answer = post(server, "/detect", content)
    assert status in (400, 422)
    assert answer["error"]


def test_addresses_and_lengths_that_cannot_be(server: TuningServer) -> None:
    assert ask(server, "GET", "http://[/", Host="127.0.0.1:1")[0] == 403
    headers = {"X-Token": server.token, "Content-Length": "9" * 5000}
    assert ask(server, "POST", "/detect", **headers)[0] == 413


def test_a_port_in_use_is_named(server: TuningServer) -> None:
    with pytest.raises(DetectError, match=f"port {server.server_port}: .*: expected another"):
        serve(server.session, server.server_port)


def test_settings_and_labels_are_saved(server: TuningServer, tmp_path: Path) -> None:
    label = {"px": 0.5, "py": -2.0, "quality": 0.9, "cxx": 1e-4, "cxy": 0.0, "cyy": 2e-4, "id": 17}
    content = {"settings": {"radius_m": 0.06, "polarity": "dark"}, "labels": {"1": [label]}}
    for _ in range(2):  # it replaces its own files
        status, answer = post(server, "/save", content)
        assert status == 200, answer
    saved = read_settings(tmp_path / "tuned" / "tuned.json")
    assert saved.circles == CircleSettings(radius_m=0.06, polarity="dark")
    frames = list(read_frames(tmp_path / "tuned" / "labels.circles"))
    assert [len(frame.circles) for frame in frames] == [0, 1, 0]
    (row,) = frames[1].circles
    assert (row.px, row.py, row.ids) == (0.5, -2.0, (17,))


def test_a_page_that_is_loaded_again_begins_with_what_was_saved(
    server: TuningServer, tmp_path: Path
) -> None:
    label = {"px": 0.5, "py": -2.0, "quality": 0.9, "cxx": 1e-4, "cxy": 0.0, "cyy": 2e-4, "id": 17}
    post(server, "/save", {"settings": {"radius_m": 0.06}, "labels": {"1": [label]}})
    described = server.session.described()
    assert described["labels"] == {"1": [label]}
    assert described["settings"]["radius_m"] == 0.06
    post(server, "/save", {"settings": {}, "labels": {"1": []}})  # the label is removed again
    frames = read_frames(tmp_path / "tuned" / "labels.circles")
    assert [len(frame.circles) for frame in frames] == [0, 0, 0]


def test_every_slider_is_a_setting(server: TuningServer) -> None:
    _, page = ask(server, "GET", f"/?token={server.token}")
    sliders = re.findall(r'\["(\w+)", "[^"]+", [-\d.]+, [-\d.]+, [\d.]+\]', page.decode())
    assert len(sliders) == 8
    assert set(sliders) <= set(asdict(CircleSettings()))


def test_a_browser_that_leaves_shows_no_traceback(
    server: TuningServer, capsys: pytest.CaptureFixture[str]
) -> None:
    for error in (BrokenPipeError(), ConnectionResetError()):
        try:
            raise error
        except OSError:
            server.handle_error(None, None)
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("name", ["tuned.json", "labels.circles"])
def test_files_that_could_not_be_saved_are_named_at_the_start(
    project_root: Path, tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / name).write_text("mine")
    assert main(["tune", str(project_root / "images" / "e"), "--serve", "-o", str(tmp_path)]) == 1
    assert f"{name}: exists already" in capsys.readouterr().err


def test_files_of_others_are_not_replaced(server: TuningServer, tmp_path: Path) -> None:
    (tmp_path / "tuned").mkdir()
    mine = tmp_path / "tuned" / "tuned.json"
    mine.write_text("mine")
    status, answer = post(server, "/save", {"settings": {}, "labels": {}})
    assert status == 422
    assert "tuned.json" in answer["error"]
    assert mine.read_text() == "mine"


@pytest.mark.long
def test_a_browser_shows_the_discs(server: TuningServer, tmp_path: Path) -> None:
    post(server, "/detect", {"frame": 0, "settings": {}})  # compiles
    shown, said = in_browser(server.address, tmp_path / "profile", "--virtual-time-budget=10000")
    assert "rejected, " in shown
    assert "e.0000 (1 of 3)" in shown
    assert "CONSOLE" not in said
