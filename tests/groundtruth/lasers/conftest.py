"""Four scanners in the empty room."""

from __future__ import annotations

import pytest

from redetect.groundtruth.lasers.scanners import Scanner
from redetect.groundtruth.lasers.tracking_kernels import FixedScanners
from tests.groundtruth.lasers.scene import four_scanners, tables_of


@pytest.fixture(scope="session")
def scanners() -> tuple[Scanner, ...]:
    return four_scanners()


@pytest.fixture(scope="session")
def tables(scanners: tuple[Scanner, ...]) -> FixedScanners:
    return tables_of(scanners)
