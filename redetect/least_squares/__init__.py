"""Nonlinear least squares with robust losses (`solver`), and covariances (`covariance`).

Fits of a few numbers inside a compiled kernel or a filter stay there: a call of this would cost
more than the fit.
"""
