"""A page for tuning: an image of a run, its discs with the current settings, and explanations.

``detect tune RUN --serve`` starts a server of the standard library for one browser on the same
machine. It listens on the loopback interface only, and answers only requests with the token of the
page's address and this machine's name as host: other users, and other pages in the browser, get no
access. Detections are the same as those of all other commands.
"""

from __future__ import annotations

import hmac
import json
import math
import secrets
import sys
import threading
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs

from detect.drawing.frame import png_of
from detect.errors import DetectError
from detect.explanation import explain_discs
from detect.lean import search_of
from detect.projection import circle_on_floor
from detect.runs.frame import detect_batch
from detect.runs.plan import FramePlan, FrameTask
from detect.settings import CircleSettings
from detect.settings_files import checked_settings, settings_text
from detect.sources.grey_images import read_image
from detect.sources.interface import Run, RunFrame
from redetect.array_types import GreyImage
from redetect.json_text import json_text
from redetect.landmarks import CircleLandmark, Frame
from redetect.landmarks.files import format_frame, format_head
from redetect.messages import OneLineError
from redetect.plane import ellipses
from redetect.storage import demand_free, write_bytes

SETTINGS_NAME, LABELS_NAME = "tuned.json", "labels.circles"
#: Longest request: some hundred settings, and labels of every frame.
_LONGEST_BYTES = 1 << 22
_OUTLINE = 32  #: Number of points of an outline.
_SIGMAS = 3.0  #: Semi-axes of an ellipse in standard deviations.
_LABELS_HEAD = "Discs with identifiers given by hand, on the page of `detect tune --serve`."


@dataclass
class TuningSession:
    """Data that the page shows and saves; methods may be called by several threads."""

    run: Run
    frames: Sequence[RunFrame]
    settings: CircleSettings  # that the page begins with
    output: Path  # the folder that settings and labels are saved in
    force: bool = False  #: Replace files that were there before the session.
    #: Labels last saved, by number of the frame: a page that is loaded again begins with them.
    labels: Mapping[str, Any] = field(default_factory=dict)
    _saved: set[str] = field(default_factory=set)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def __post_init__(self) -> None:
        self.image = lru_cache(maxsize=16)(self._image)

    def _image(self, number: int) -> GreyImage:
        return read_image(self.frames[number], self.run.camera)

    def described(self) -> dict[str, Any]:
        """Description of the run for the page."""
        camera = self.run.camera
        return {
            "name": self.run.name,
            "frames": [frame.step.prefix for frame in self.frames],
            "settings": asdict(self.settings),
            "labels": self.labels,
            "width": camera.width,
            "height": camera.height,
            # Pixels need not be square: single fields of interlaced frames are half as high.
            "aspect": camera.scale_x / camera.scale_y,
        }

    def detect(self, number: int, values: Mapping[str, Any]) -> dict[str, Any]:
        """The discs of a frame with some settings, and the rejected candidates."""
        settings, camera = checked_settings("circles", values, CircleSettings), self.run.camera
        candidates, suggestions, lean = list[dict[str, Any]](), list[str](), None
        if settings.refine:  # otherwise, centres are rejected for their quality only
            explained = explain_discs(self.image(number), camera, settings)
            candidates, suggestions = explained.records(), list(explained.suggestions)
            lean = explained.lean
        plan = FramePlan(camera, circles=settings, levelling="none", lean=lean)
        (frame,) = detect_batch([FrameTask(self.frames[number])], plan)
        if frame.discs is None:
            raise DetectError(str(frame.error))
        found, (leaning, _) = frame.discs, search_of(camera, settings, lean)

        def outline(level_xy: Any) -> list[list[float]]:
            places = leaning.project_floor(circle_on_floor(level_xy, settings.radius_m, _OUTLINE))
            return [[float(u), float(v)] for u, v in places if math.isfinite(u)]

        level_xy = leaning.floor_from_pixel(camera.project_floor(found.floor_xy))
        rows = zip(
            found.floor_xy, level_xy, found.covariance, found.quality, found.evidence, strict=True
        )
        discs = [
            {
                "x": float(xy[0]),
                "y": float(xy[1]),
                "covariance": [float(c[0, 0]), float(c[0, 1]), float(c[1, 1])],
                "quality": float(quality),
                "evidence": float(evidence),
                "outline": outline(level),
                "ellipse": ellipses(xy, c, _SIGMAS, _OUTLINE).tolist(),
            }
            for xy, level, c, quality, evidence in rows
        ]
        rejected = [
            {**row, "outline": outline((row["x_m"], row["y_m"]))}
            for row in candidates
            if row["stage"] != "disc"
        ]
        return {"discs": discs, "rejected": rejected, "suggestions": suggestions}

    def save(self, values: Mapping[str, Any], labels: Mapping[str, Any]) -> list[str]:
        """Write the settings, and the labels of frames by number; returns messages."""
        settings = checked_settings("circles", values, CircleSettings)
        contents = {SETTINGS_NAME: settings_text(circles=settings).encode()}
        labelled = {int(number): [_label(one) for one in some] for number, some in labels.items()}
        if any(labelled.values()) or any(self.labels.values()):
            contents[LABELS_NAME] = format_head(_LABELS_HEAD) + b"".join(
                format_frame(Frame(frame.step, tuple(labelled.get(number, ()))))
                for number, frame in enumerate(self.frames)
            )
        with self._lock:
            self.output.mkdir(parents=True, exist_ok=True)
            # Files written by the page itself may be replaced any time.
            others = [self.output / name for name in contents if name not in self._saved]
            demand_free(others, overwrite=self.force)
            for name, content in contents.items():
                write_bytes(self.output / name, content, overwrite=True)
            self._saved.update(contents)
            self.settings, self.labels = settings, labels
        return [str(self.output / name) for name in contents]


def _label(values: Mapping[str, Any]) -> CircleLandmark:
    """The row of a disc with an identifier assigned by hand."""
    try:
        numbers = {name: float(value) for name, value in values.items() if name != "id"}
        return CircleLandmark(**numbers, ids=(int(values["id"]),))
    except (KeyError, TypeError, ValueError, OverflowError):
        raise DetectError(
            "a label: expected a position, its covariance and an identifier"
        ) from None


class TuningServer(ThreadingHTTPServer):
    """Serves the page of a session on the loopback; `address` is what to open."""

    daemon_threads = True

    def __init__(self, session: TuningSession, port: int = 0) -> None:
        self.session, self.token = session, secrets.token_urlsafe(24)
        super().__init__(("127.0.0.1", port), _Handler)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Keep off the terminal that a browser no longer waits for an answer."""
        if not isinstance(sys.exc_info()[1], OSError):
            super().handle_error(request, client_address)

    @property
    def address(self) -> str:
        """The page's address, with the token."""
        return f"http://127.0.0.1:{self.server_port}/?token={self.token}"


class _Handler(BaseHTTPRequestHandler):
    server: TuningServer
    protocol_version = "HTTP/1.1"
    timeout = 60  # of an idle connection, seconds

    def log_message(self, *_: Any) -> None:
        """Keep requests off the terminal."""

    def do_GET(self) -> None:
        """The page, or the image of a frame."""
        path, _, query = self.path.partition("?")
        if not self._allowed(parse_qs(query).get("token", [""])[0]):
            return
        session = self.server.session
        if path == "/":
            page = files("detect").joinpath("tuning_page.html").read_text("utf-8")
            described = {**session.described(), "token": self.server.token}
            content = json_text(described, indent=None).replace("<", "\\u003c")
            self._answer("text/html; charset=utf-8", page.replace("@RUN@", content).encode())
        elif path.startswith("/frame/"):
            self._try(lambda: ("image/png", png_of(session.image(self._number(path[7:])))))
        else:
            self._refuse(HTTPStatus.NOT_FOUND, "no such page")

    def do_POST(self) -> None:
        """Detect, or save."""
        if not self._allowed(self.headers.get("X-Token", "")):
            return
        length = self.headers.get("Content-Length", "")
        if not length.isdecimal() or len(length) > 9 or int(length) > _LONGEST_BYTES:
            self._refuse(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, "the request is too long")
            return
        body = self.rfile.read(int(length))
        self._try(lambda: ("application/json", json_text(self._carried_out(body)).encode()))

    def _carried_out(self, body: bytes) -> dict[str, Any]:
        request, session = json.loads(body), self.server.session
        if self.path == "/detect":
            return session.detect(self._number(request["frame"]), request["settings"])
        if self.path == "/save":
            return {"saved": session.save(request["settings"], request["labels"])}
        raise DetectError("no such request")

    def _number(self, word: Any) -> int:
        number, count = int(word), len(self.server.session.frames)
        if not 0 <= number < count:
            raise DetectError(f"no frame {number}: expected 0 to {count - 1}")
        return number

    def _allowed(self, token: str) -> bool:
        """Whether the request has the token, and this machine's own name as host.

        Another page can make its own host name point here; then the request has that name.
        """
        host = self.headers.get("Host", "").rpartition(":")[0]
        known = hmac.compare_digest(token.encode(), self.server.token.encode())
        if known and host in ("127.0.0.1", "localhost"):
            return True
        self._refuse(HTTPStatus.FORBIDDEN, "open the address that the terminal shows")
        return False

    def _try(self, work: Any) -> None:
        try:
            kind, content = work()
        except (OneLineError, OSError) as error:
            self._refuse(HTTPStatus.UNPROCESSABLE_ENTITY, str(error))
        except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError):
            self._refuse(HTTPStatus.BAD_REQUEST, "not understood")
        else:
            self._answer(kind, content)

    def _refuse(self, status: HTTPStatus, words: str) -> None:
        self.close_connection = True
        self._answer("application/json", json_text({"error": words}).encode(), status)

    def _answer(self, kind: str, content: bytes, status: HTTPStatus = HTTPStatus.OK) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Referrer-Policy", "no-referrer")
        self.send_header(
            "Content-Security-Policy",
            "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; "
            "img-src 'self'; connect-src 'self'; base-uri 'none'; form-action 'none'",
        )
        self.end_headers()
        self.wfile.write(content)


def serve(session: TuningSession, port: int = 0) -> int:
    """Serve the page until an interrupt; returns the exit code."""
    try:
        server = TuningServer(session, port)
    except OSError as error:
        raise DetectError(f"port {port}: {error.strerror}: expected another --port") from None
    with server:
        print(f"{server.address}\nCtrl-C ends it.", flush=True)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            print()
    return 0
