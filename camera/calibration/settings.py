"""How a camera is calibrated, and which of its lens's coefficients are free."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from camera.calibration.model import FREE_COEFFICIENTS, POLYNOMIAL, TANGENTIAL, free_span
from camera.errors import CalibrationError
from redetect.storage.bounds import ABOVE_0, demand, whole


class FreeLens(NamedTuple):
    """Which of the distortion's coefficients are free."""

    coefficients: int
    """Number of the rational ones, 0 to 5 (`calibration_model.FREE_COEFFICIENTS`)."""
    tangential: bool = False
    """Whether p1 and p2 are."""
    polynomial: int = 0
    """How many of k1, k2, k3 are."""

    def span(self, aspect: float | None) -> NDArray[np.float64]:
        """`calibration_model.free_span`."""
        return free_span(
            self.coefficients, aspect, tangential=self.tangential, polynomial=self.polynomial
        )

    def __str__(self) -> str:
        names = (
            *FREE_COEFFICIENTS[self.coefficients], *POLYNOMIAL[: self.polynomial],
            *(TANGENTIAL if self.tangential else ()),
        )  # fmt: skip
        return " ".join(names) or "none"

    @property
    def label(self) -> str:
        """How many radial coefficients are free, and which kinds there are."""
        kinds = [str(self.polynomial or self.coefficients)]
        kinds += ["polynomial"] if self.polynomial else []
        return " ".join([*kinds, "tangential"] if self.tangential else kinds)


@dataclass(frozen=True)
class CalibrationSettings:
    """How to calibrate.

    Attributes
    ----------
    aspect : float or None
        scaleY / scaleX: 1 for square pixels, 0.5 for every second line of them; None if both scales
        are free.
    coefficients : int or None
        Number of free radial coefficients (0 to 5, of the polynomial 0 to 3); None: as many as make
        the hold-out error smaller. Of the rational function, unless `polynomial` is true.
    tangential : bool or None
        Whether the tangential terms p1 and p2 are free; None: if that makes the hold-out error
        smaller and they are more than noise.
    polynomial : bool or None
        Whether the radial distortion is the polynomial k1, k2, k3, not the rational one; None: if
        that needs fewer coefficients, or makes the hold-out error much smaller.
    robust : bool
        Huber's loss; points found wrongly pull less.
    keep_outliers : bool
        Keep pictures whose residuals are far above the others'.
    """

    aspect: float | None = 1.0
    coefficients: int | None = None
    tangential: bool | None = None
    polynomial: bool | None = None
    robust: bool = True
    keep_outliers: bool = False

    def __post_init__(self) -> None:
        if self.aspect is not None:
            demand(self, CalibrationError, aspect=ABOVE_0)
        if self.coefficients is not None:
            demand(self, CalibrationError, coefficients=whole(0, self._all))

    @property
    def _all(self) -> int:
        return len(POLYNOMIAL) if self.polynomial else len(FREE_COEFFICIENTS) - 1

    @property
    def most(self) -> int:
        """The largest number of radial coefficients that may be free."""
        return self._all if self.coefficients is None else self.coefficients

    def lens(self, count: int, *, tangential: bool = False) -> FreeLens:
        """The lens with `count` free radial coefficients."""
        if self.polynomial:
            return FreeLens(0, tangential, count)
        return FreeLens(count, tangential)
