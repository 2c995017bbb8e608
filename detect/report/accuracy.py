"""The parts of a report that hold rows against a reference."""

from __future__ import annotations

from typing import Any

import numpy as np

from detect.comparison.lines_result import LineComparison
from detect.comparison.result import Comparison, NormalisedError
from detect.comparison.tables import number
from detect.report.figures import errors_figure, rates_figure, whitened_figure
from detect.report.inputs import ReportInputs
from detect.report.parts import Part, figure_part, range_text, scaled, share_text
from detect.report.statistics import (
    NORMAL_WITHIN,
    RateCurve,
    Residuals,
    disc_rates,
    disc_residuals,
    line_rates,
    line_residuals,
    normality,
)
from detect.tune.curve import knee

_CURVE_POINTS = 41
_TABLE_POINTS = 5
_SIGMA = "\N{GREEK SMALL LETTER SIGMA}"


def disc_parts(inputs: ReportInputs) -> list[Part]:
    """Discs against the reference: rates, errors, and whether covariances are right."""
    result = inputs.discs
    if result is None:
        return [_no_reference("map.circles", "--reference")]
    curve = disc_rates(inputs.disc_pairs, inputs.gate, _quality_levels(inputs))
    residuals = disc_residuals(inputs.disc_pairs, inputs.gate)
    error = f"{scaled(result.error_median_m, 1e3, 1)} mm"
    most = f"{scaled(result.error_95_m, 1e3, 1)} mm"
    errors = (("median error", error), ("95 %", most))
    return [
        _outcome(result, f"within {inputs.gate.gate_m:g} m", errors),
        *_rates(curve, "least quality", "quality", 1.0),
        *_honesty(residuals, result.normalised_error, "two components for each matched disc"),
        figure_part(
            errors_figure(residuals, "mm", 1e3),
            "Position errors of matched discs over their distance from the robot and over bearing: "
            "each disc, medians and 95 % quantiles in bins of equally many.",
        ),
        Part(
            "table",
            caption="By forward distance; error and quality are medians",
            head=("metres", "reference", "missed", "recall", "detected", "extra", "precision",
                  "error / mm", "reference quality", "detected quality"),
            rows=tuple(
                (range_text(part.from_m, part.to_m), str(part.reference), str(part.missed),
                 number(part.recall, 3), str(part.detected), str(part.extra),
                 number(part.precision, 3), scaled(part.error_median_m, 1e3, 1),
                 number(part.reference_quality_median, 3),
                 number(part.detected_quality_median, 3))
                for part in result.bins
                if part.reference or part.detected
            ),
        ),
    ]  # fmt: skip


def line_parts(inputs: ReportInputs) -> list[Part]:
    """Verticals against the reference: rates, errors, and whether standard deviations are right."""
    result = inputs.lines
    if result is None:
        return [_no_reference("map.lines", "--reference-lines")]
    sigma = [row.sigma for pair in inputs.line_pairs for row in pair.detected]
    shares = np.linspace(0.0, 1.0, _CURVE_POINTS)
    levels = np.unique(np.quantile(sigma, shares)) if sigma else np.zeros(0)
    # Quantiles between rows may round below the greatest.
    curve = line_rates(inputs.line_pairs, inputs.line_gate, np.nextafter(levels, np.inf))
    residuals = line_residuals(inputs.line_pairs, inputs.line_gate)
    gate = f"within {inputs.line_gate.tolerance_deg:g}° or {inputs.line_gate.sigmas:g} {_SIGMA}"
    error = f"{number(result.bearing_median_deg, 3)}°"
    most = f"{number(result.bearing_95_deg, 3)}°"
    return [
        _outcome(
            result, gate,
            (("found with another", str(result.joined)), ("median error", error), ("95 %", most)),
        ),
        *_rates(curve, f"largest {_SIGMA} of the bearing / deg", f"{_SIGMA} / deg", -180.0 / np.pi),
        *_honesty(residuals, result.normalised_error, "one for each matched vertical"),
        figure_part(
            errors_figure(residuals, "deg", 180.0 / np.pi),
            "Bearing errors of matched verticals, without sign, over bearing: each vertical, "
            "medians and 95 % quantiles in bins of equally many.",
        ),
    ]  # fmt: skip


def _outcome(
    result: Comparison | LineComparison, gate: str, errors: tuple[tuple[str, str], ...]
) -> Part:
    return Part(
        "figures",
        entries=(
            ("reference rows", str(result.reference)),
            ("detected rows", str(result.detected)),
            (f"matched {gate}", str(result.matched)),
            ("missed", str(result.missed)),
            ("extra", str(result.extra)),
            ("recall", number(result.recall, 4)),
            ("precision", number(result.precision, 4)),
            *errors,
        ),
    )


def _rates(curve: RateCurve, axis: str, name: str, factor: float) -> list[Part]:
    if not len(curve.threshold):
        return [Part("note", "No rows: no rates over thresholds.")]
    best = knee(curve.recall, curve.precision)
    chosen = set(np.linspace(0, len(curve.threshold) - 1, _TABLE_POINTS).astype(int).tolist())
    if best is not None:
        chosen.add(best)
    rows = tuple(
        (f"{factor * curve.threshold[k]:.3g}" + (" (knee)" if k == best else ""),
         str(curve.kept[k]), share_text(curve.recall[k]), share_text(curve.precision[k]))
        for k in sorted(chosen, key=lambda k: factor * curve.threshold[k])
    )  # fmt: skip
    return [
        figure_part(
            rates_figure(curve, axis, factor=factor),
            f"Recall and precision of the rows that a threshold leaves ({axis}); on the right one "
            "over the other. The knee is the point farthest beyond the chord between the ends.",
        ),
        Part(
            "table", caption=f"Rates over the threshold ({axis})",
            head=(name, "rows kept", "recall", "precision"), rows=rows,
        ),
    ]  # fmt: skip


def _honesty(residuals: Residuals, error: NormalisedError, what: str) -> list[Part]:
    figures = normality(residuals.whitened)
    if figures is None:
        return [Part("note", "No matched rows with a usable covariance: nothing to whiten.")]
    within = [
        (f"within {k} {_SIGMA} (normal: {usual:.3f})", f"{share:.3f}")
        for k, share, usual in zip((1, 2, 3), figures.within, NORMAL_WITHIN)
    ]
    entries = [
        ("mean", f"{figures.mean:.3f}"),
        ("deviation", f"{figures.deviation:.3f}"),
        *within,
        ("squared, per degree of freedom", number(error.per_dof, 3)),
    ]
    if error.band is not None:
        entries.append(("95 % band of that", f"{error.band[0]:.3f} to {error.band[1]:.3f}"))
    return [
        figure_part(
            whitened_figure(residuals),
            f"Residuals in units of the covariance that the rows state, {what}: standard normal if "
            "the covariances are right, wider if they promise too much.",
        ),
        Part("figures", entries=tuple(entries)),
    ]


def _no_reference(usual: str, flag: str) -> Part:
    words = f"No reference rows: expected {usual} in the run folder, or a file named by {flag}."
    return Part("note", words)


def _quality_levels(inputs: ReportInputs) -> np.ndarray[Any, np.dtype[np.float64]]:
    quality = [row.quality for pair in inputs.disc_pairs for row in pair.detected]
    if not quality:
        return np.zeros(0)
    return np.linspace(min(quality), max(quality), _CURVE_POINTS)
