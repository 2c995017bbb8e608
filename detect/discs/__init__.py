"""Discs on the floor: quality of centres, the fit of a disc, the evidence that it is one."""
