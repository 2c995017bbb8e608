"""Settings that make no sense are refused by name; the published ones are the report's."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from detect.circles import disc_shape
from detect.errors import DetectError
from detect.settings import PUBLISHED, CircleSettings

NONSENSE = [
    ("threshold", 0.0),
    ("threshold", -0.1),
    ("threshold", 1.5),
    ("threshold", math.nan),
    ("radius_m", 0.0),
    ("radius_m", -0.1),
    ("radius_m", math.nan),
    ("radius_m", 0.05),
    ("radius_m", 0.14),
    ("separation_m", -0.01),
    ("separation_m", math.inf),
    ("separation_m", math.nan),
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


@pytest.mark.parametrize(("inner", "outer"), [(0.10, 0.14), (0.12, 0.14)])
def test_a_disc_lies_between_its_outlines(inner: float, outer: float) -> None:
    with pytest.raises(DetectError, match=r"radius_m is 0\.1: expected between the outlines"):
        CircleSettings(inner_radius_m=inner, outer_radius_m=outer)


@given(st.floats(0.0, 1.0, exclude_min=True))
def test_every_quality_can_be_the_threshold(threshold: float) -> None:
    assert CircleSettings(threshold=threshold).threshold == threshold


def test_published_preset_is_the_report() -> None:
    assert (PUBLISHED.radius_m, PUBLISHED.inner_radius_m, PUBLISHED.outer_radius_m) == (
        0.10,
        0.06,
        0.14,
    )
    assert (PUBLISHED.samples, PUBLISHED.threshold, PUBLISHED.border_px) == (16, 0.6, 12)
    assert not PUBLISHED.verify
    assert not PUBLISHED.refine
    assert PUBLISHED.separation_m == PUBLISHED.noise_floor == 0.0
    assert PUBLISHED.polarity == "any"


def test_table_is_made_for_the_settings() -> None:
    settings = replace(
        CircleSettings(), samples=24, inner_radius_m=0.07, outer_radius_m=0.13, border_px=9
    )
    shape = disc_shape(settings)
    assert (shape.samples, shape.inner_radius_m, shape.outer_radius_m) == (24, 0.07, 0.13)
    assert (shape.border_px, shape.far_limit_m_per_px) == (9, settings.far_limit_m_per_px)
