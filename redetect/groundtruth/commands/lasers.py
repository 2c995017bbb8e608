"""The command ``groundtruth lasers``: scanners measured by hand in, poses on the map out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from redetect.groundtruth.commands.outputs import check_outputs, provenance, warn
from redetect.groundtruth.lasers import scanners
from redetect.groundtruth.lasers.alignment import Alignment, align_scanners, icp_by_step
from redetect.groundtruth.lasers.building import find_building, read_building
from redetect.groundtruth.lasers.walls import still_scan
from redetect.groundtruth.options import Lasers
from redetect.groundtruth.report.pictures import draw_alignment
from redetect.groundtruth.trajectories.streams import pose_differences
from redetect.storage import write_bytes

#: Scanners this many standard deviations from their measured pose are reported.
_FAR_OFF_SIGMA = 5.0
#: Offsets of walls from the map above which a warning is printed (m).
_NOTED_M = 0.001
#: Share of readings on walls of the map below which a warning is printed.
_LEAST_ON_MAP = 0.5
#: Steps of the ICP that the picture shows.
_ICP_STEPS = 30


def perform(options: Lasers) -> int:
    """Execute the command; returns the exit code."""
    session = options.session
    output = options.output or session / "aligned.json"
    picture = output.with_suffix(".png")
    check_outputs([output, picture], options.force)
    by_hand = session / "scanners.json"
    stated = scanners.read_scanners(by_hand)
    map_file = find_building(session)
    building = read_building(map_file)
    empties = [
        scanners.read_scans(scanners.find_scans(session / "empty", s.name), s.readings)
        for s in stated
    ]
    measured = scanners.with_measured_noise(stated, empties)
    for text in scanners.noise_warnings(stated, measured, by_hand):
        warn(text)
    alignment = align_scanners(measured, empties, building, options.settings)

    pairs = zip(measured, alignment.scanners)
    far_off = [after.name for before, after in pairs if _sigmas(before, after) > _FAR_OFF_SIGMA]
    extra: dict[str, Any] = {
        **provenance(options.settings, [by_hand, map_file]),
        "steps": {name: poses.tolist() for name, poses in alignment.steps.items()},
        "pairs": [
            {"scanners": [measured[i].name, measured[j].name], "explained": share}
            for (i, j), share in sorted(alignment.pairs.items())
        ],
        "beams_on_map": alignment.matched.tolist(),
        "rms_m": alignment.rms_m.tolist(),
        "far_off_measured": far_off,
        "undetermined": list(alignment.undetermined),
        "inconsistent": list(alignment.inconsistent),
        "map_sigma_m": alignment.map_sigma_m,
        "covariance": {
            "scanners": [s.name for s in alignment.scanners],
            "matrix": alignment.covariance.tolist(),
        },
    }
    del extra["version"]  # that of the file's form is there
    scanners.write_scanners(output, alignment.scanners, extra, overwrite=options.force)
    points = [still_scan(a, b.ranges_mm).points for a, b in zip(measured, empties)]
    by_step = [
        icp_by_step(cloud, building, scanner.pose, options.settings, _ICP_STEPS)
        for cloud, scanner in zip(points, measured)
    ]
    drawn = draw_alignment(measured, alignment, points, building, by_step)
    write_bytes(picture, drawn, overwrite=options.force)
    _print_differences(measured, alignment, far_off)
    for one, seen, matched in zip(alignment.scanners, points, alignment.matched):
        if matched < _LEAST_ON_MAP * len(seen):
            warn(
                f"scanner {one.name}: only {100.0 * matched / len(seen):.0f} % of its readings lie "
                f"on walls of {map_file}: expected the map of this place, in metres"
            )
    return 0


def _print_differences(
    measured: Sequence[scanners.Scanner], alignment: Alignment, far_off: Sequence[str]
) -> None:
    for k, (before, after) in enumerate(zip(measured, alignment.scanners)):
        shift = pose_differences(after.pose, before.pose)
        sigma = np.sqrt(np.diag(after.covariance))
        print(
            f"{after.name}: moved by {1e3 * shift[0]:.1f}, {1e3 * shift[1]:.1f} mm and "
            f"{np.degrees(shift[2]):.3f} deg; sigma {1e3 * sigma[0]:.2f}, "
            f"{1e3 * sigma[1]:.2f} mm, {np.degrees(sigma[2]):.4f} deg; {alignment.matched[k]} "
            f"beams on the map, rms {1e3 * alignment.rms_m[k]:.2f} mm"
        )
    if alignment.map_sigma_m > _NOTED_M:
        warn(
            f"the walls are off the map by some {1e3 * alignment.map_sigma_m:.0f} mm: this was "
            "estimated, too, and the scanners' errors are common to all"
        )
    for name in far_off:
        warn(f"scanner {name}: was measured wrong, or another place of the map is similar")
    for name in alignment.undetermined:
        warn(f"scanner {name}: a direction is not determined")
    for name in alignment.inconsistent:
        warn(f"scanner {name}: its pose on the map disagrees with the other scanners")


def _sigmas(before: scanners.Scanner, after: scanners.Scanner) -> float:
    """Distance of a scanner from its measured pose, in the measurement's standard deviations."""
    shift = pose_differences(after.pose, before.pose)
    covariance = before.covariance + after.covariance
    if not np.any(before.covariance):
        return 0.0
    return float(np.sqrt(shift @ np.linalg.pinv(covariance) @ shift))
