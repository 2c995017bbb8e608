"""The parts of a report that hold rows against a reference."""

from __future__ import annotations

from typing import Any

import numpy as np

from detect.comparison.report import lean_text, levelling_text, number
from detect.comparison.result import Comparison, LineComparison, NormalisedError
from detect.report.figures import (
    distance_figure,
    errors_figure,
    floor_figure,
    rates_figure,
    whitened_figure,
)
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
from detect.tune.table import knee

_CURVE_POINTS = 41
_TABLE_POINTS = 5
_SIGMA = "\N{GREEK SMALL LETTER SIGMA}"


def disc_parts(inputs: ReportInputs) -> list[Part]:
    """Discs against the reference: rates, errors, and whether covariances are right."""
    result = inputs.discs
    if result is None:
        return [_no_reference("map.circles", "--reference")]
    curve = disc_rates(inputs.disc_pairs, inputs.gate, _quality_levels(inputs))
    figures = [
        ("median difference on the floor", f"{scaled(result.error_median_m, 1e3, 1)} mm"),
        ("95 %", f"{scaled(result.error_95_m, 1e3, 1)} mm"),
    ]
    where = "on the floor"
    if result.in_image:
        where = "in the image"
        figures.insert(
            0, ("median difference in the image", f"{number(result.image_median_px, 2)} px")
        )
    parts = [_outcome(result, where, tuple(figures))]
    if result.in_image:
        parts.append(
            Part(
                "text",
                f"{sentence(levelling_text(result))} A detected row fits a reference row if they "
                f"are at most half the disc's image apart ({result.options.least_px:g} px for "
                "those that are smaller).",
            )
        )
    parts += [
        figure_part(
            distance_figure(result.bins),
            "Rows, recall and precision by forward distance, each side's rows by their own.",
        ),
        *_rates(curve, "least quality", "quality", 1.0),
    ]
    if result.matched:
        parts.append(
            figure_part(
                floor_figure(result.pairs, lean=result.lean is not None),
                "Where on the floor the two sides put the same disc, detected minus reference: "
                "each pair, and medians in bins of equally many.",
            )
        )
    if result.lean is not None:
        parts += [
            Part("text", f"One lean for all frames: {lean_text(result.lean)}.".replace("+-", "±")),
            _floor(result),
        ]
    error = result.normalised_error if result.lean is None else result.lean.normalised_error
    what = "two components for each matched disc"
    if result.lean is not None:
        what += ", after the common lean"
    return [*parts, *_honesty(disc_residuals(result.pairs), error, what)]


def sentence(text: str) -> str:
    """The same with a capital letter and a full stop."""
    return f"{text[:1].upper()}{text[1:]}."


def _floor(result: Comparison) -> Part:
    rows = []
    for part in result.floor:
        if part.before.pairs == 0 or part.after is None:
            continue
        figures = [
            scaled(value, 1e3, 0)
            for one in (part.before, part.after)
            for value in (one.median_m, one.most_m, one.along_m, one.across_m)
        ]
        rows.append((range_text(part.from_m, part.to_m), str(part.before.pairs), *figures))
    return Part(
        "table",
        caption="Differences on the floor in mm by forward distance of the reference row in m, "
        "as the rows are and after the common lean; along (farther) and across (left) are medians",
        head=("metres", "pairs", "median", "95 %", "along", "across",
              "after: median", "95 %", "along", "across"),
        rows=tuple(rows),
    )  # fmt: skip


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
            "the covariances are right, wider if they are too small.",
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
