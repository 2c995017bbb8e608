"""Settings that make no sense are refused by name; the published ones are the report's."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from detect.circles import disc_shape
from detect.errors import DetectError
from detect.settings import PUBLISHED, REPORT, CircleSettings

NONSENSE = [
    ("threshold", 0.0),
    ("threshold", -0.1),
    ("threshold", 1.5),
    ("threshold", math.nan),
    ("radius_m", 0.0),
    ("radius_m", -0.1),
    ("radius_m", math.nan),
    ("separation", -0.01),
    ("separation", math.inf),
    ("separation", math.nan),
    ("noise_floor", -1.0),
    ("noise_floor", math.nan),
    ("systematic_px", -0.1),
    ("tilt_sigma_deg", math.nan),
    ("evidence", math.nan),
    ("evidence", math.inf),
]


@pytest.mark.parametrize(("name", "value"), NONSENSE)
def test_nonsense_is_refused_by_name(name: str, value: float) -> None:
    with pytest.raises(DetectError) as refusal:
        CircleSettings(**{name: value})  # type: ignore[arg-type]
    assert str(refusal.value).startswith(f"{name} is {value:g}: expected ")


@pytest.mark.parametrize(("name", "value"), [("inner_ring", 1.0), ("outer_ring", 1.0)])
def test_a_disc_lies_between_its_outlines(name: str, value: float) -> None:
    with pytest.raises(DetectError, match=rf"{name} is 1: expected (less|more) than 1, the disc"):
        CircleSettings(**{name: value})  # type: ignore[arg-type]


@given(st.floats(0.0, 1.0, exclude_min=True))
def test_every_quality_can_be_the_threshold(threshold: float) -> None:
    assert CircleSettings(threshold=threshold).threshold == threshold


def test_lengths_go_with_the_radius() -> None:
    for preset in (PUBLISHED, REPORT, CircleSettings()):
        half = replace(preset, radius_m=0.05)
        for name in (
            "inner_radius_m",
            "outer_radius_m",
            "far_limit_m_per_px",
            "separation_m",
        ):
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
