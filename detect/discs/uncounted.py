"""How kernels that work in given memory are compiled: without counting references to arrays."""

from __future__ import annotations

#: For kernels that take arrays in tuples, allocate nothing and return no array. Numba leaves out
#: counting references by itself only where arrays are arguments of their own; else every part of
#: a tuple that is looked at is counted, with locked additions: a tenth of the search for discs.
#: The compiler refuses this for kernels that allocate.
UNCOUNTED = {"_nrt": False}
