"""The table with which candidates for discs are found."""

from __future__ import annotations

import pytest

from camera import Camera
from detect.circles import vote_shape
from detect.settings import CircleSettings
from lut import VoteTable, build_vote_table


@pytest.fixture(scope="session")
def table(published_camera: Camera) -> VoteTable:
    return build_vote_table(published_camera, vote_shape(CircleSettings()))
