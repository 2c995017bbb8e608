"""Nonlinear least squares with robust losses (`solver`), and covariances (`covariance`).

Small fits inside a compiled kernel or a filter stay there: a call would cost more than the fit.
"""

from typing import Literal

#: Robust losses.
LossKind = Literal["none", "huber", "cauchy", "geman-mcclure"]
