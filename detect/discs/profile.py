"""The grey-value profile across the edge of a blurred disc, in closed form.

A disc of radius 1, blurred by an isotropic Gaussian of width t, has at distance 1 + z t from its
centre a value W(z, t): the probability that a Gaussian about that point falls into the disc (a
noncentral chi-square distribution of two degrees of freedom). A straight edge would have Phi(-z).
The curved one is very nearly a straight edge moved and bent a little,

    W(z, t) = Phi(-g),    g = z + t (1/2 + t Q(z, t)),

because a Gaussian blur moves an edge of curvature 1/R by sigma^2 / (2 R) towards its centre. Q is a
polynomial, fitted once over ``|z|`` <= `Z_LIMIT` and t <= `T_LIMIT` by least squares, reweighted
until the largest error of W was least: it is 0.0011 (the tests integrate the disc and check that).
"""

from __future__ import annotations

#: The reach of the polynomial.
Z_LIMIT = 4.0
T_LIMIT = 0.4

#: Coefficients of Q: rows are powers 0 to 5 of z, columns powers 0 to 2 of t.
BEND = (
    (-1.764051e-01, 9.261172e-01, -9.298910e-01),
    (-1.769709e-01, -1.028644e00, 1.689269e00),
    (6.787577e-01, -3.150550e00, 3.804857e00),
    (-2.493398e-01, 2.102750e00, -3.483120e00),
    (-2.104200e-01, 9.209596e-01, -7.555281e-01),
    (2.401504e-02, -2.055932e-01, 2.540854e-01),
)
