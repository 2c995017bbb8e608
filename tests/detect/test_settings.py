"""Settings that make no sense are refused by name; the published ones are the report's."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from detect.circles import disc_shape
from detect.errors import DetectError
from detect.line_settings import LineSettings
from detect.settings import PUBLISHED, REPORT, CircleSettings, MarkerSettings


@pytest.mark.parametrize(
    ("settings", "changes", "told"),
    [
        (CircleSettings, {"threshold": 0.0}, "threshold is 0: expected"),
        (CircleSettings, {"threshold": 1.5}, "threshold is 1.5: expected"),
        (CircleSettings, {"radius_m": 0.0}, "radius_m is 0: expected"),
        (CircleSettings, {"inner_ring": 1.0}, "inner_ring is 1: expected less than 1, the disc"),
        (CircleSettings, {"outer_ring": 1.0}, "outer_ring is 1: expected more than 1, the disc"),
        (LineSettings, {"threshold": 0.0}, "threshold is 0: expected"),
        (LineSettings, {"regulariser": 0.0}, "regulariser is 0: expected"),
        (LineSettings, {"sigma_along_rows": 1e6}, "sigma_along_rows is 1e\\+06: expected"),
        (LineSettings, {"sigma_across_px": 101.0}, "sigma_across_px is 101: expected"),
        (LineSettings, {"coarse_scale_px": 1e6}, "coarse_scale_px is 1e\\+06: expected"),
        (LineSettings, {"least_rows": 2}, "least_rows is 2: expected"),
        (LineSettings, {"refine_steps_px": ((0.0, 1.0),)}, "refine_steps_px is .*: expected"),
        (LineSettings, {"blurred_widths": (1.0,)}, "blurred_widths is 1: expected a number"),
        (LineSettings, {"blurred_widths": (2.0, 11.0)}, "blurred_widths is 11: expected a number"),
        (MarkerSettings, {"thresholds": ()}, "thresholds"),
        (MarkerSettings, {"thresholds": (0.5, 1.5)}, "thresholds is 1.5"),
        (MarkerSettings, {"least_explained": 2.0}, "least_explained"),
    ],
)
def test_nonsense_is_refused_by_name(
    settings: type[Any], changes: dict[str, Any], told: str
) -> None:
    """Besides what no number of any settings may be: `tests/test_bounds.py`."""
    with pytest.raises(DetectError, match=told):
        settings(**changes)


@given(st.floats(0.0, 1.0, exclude_min=True))
def test_every_quality_can_be_the_threshold(threshold: float) -> None:
    assert CircleSettings(threshold=threshold).threshold == threshold


def test_lengths_go_with_the_radius() -> None:
    for preset in (PUBLISHED, REPORT, CircleSettings()):
        half = replace(preset, radius_m=0.05)
        for name in ("inner_radius_m", "outer_radius_m", "far_limit_m_per_px", "separation_m"):
            assert getattr(half, name) == pytest.approx(0.5 * getattr(preset, name))
        shape, small = disc_shape(preset), disc_shape(half)
        assert small.stride_m == pytest.approx(0.5 * shape.stride_m)


def test_published_preset_is_the_law() -> None:
    shape = disc_shape(PUBLISHED)
    assert (shape.inner_radius_m, shape.outer_radius_m) == pytest.approx((0.08, 0.12))
    assert (shape.samples, shape.least_pairs, shape.apart_px) == (16, 13, 0.5)
    assert (shape.stride_m, shape.far_limit_m_per_px) == pytest.approx((0.04, 0.05))
    assert (PUBLISHED.threshold, PUBLISHED.least_contrast) == (0.6, 5.0)
    assert PUBLISHED.separation_m == pytest.approx(0.2)
    assert (PUBLISHED.polarity, PUBLISHED.border_px, PUBLISHED.noise_floor) == ("any", 0, 0.0)
    assert not PUBLISHED.refine


def test_report_preset_is_the_report() -> None:
    outlines = REPORT.radius_m, REPORT.inner_radius_m, REPORT.outer_radius_m
    assert outlines == pytest.approx((0.10, 0.06, 0.14))
    assert (REPORT.samples, REPORT.threshold, REPORT.border_px) == (16, 0.6, 12)
    assert not REPORT.refine
    assert REPORT.separation_m == REPORT.noise_floor == REPORT.stride == 0.0
    assert REPORT.polarity == "any"


def test_table_is_made_for_the_settings() -> None:
    settings = replace(CircleSettings(), samples=24, inner_ring=0.7, outer_ring=1.3, border_px=9)
    shape = disc_shape(settings)
    assert shape.samples == 24
    assert (shape.inner_radius_m, shape.outer_radius_m) == pytest.approx((0.07, 0.13))
    assert (shape.border_px, shape.far_limit_m_per_px) == (9, settings.far_limit_m_per_px)
