"""How good poses are: against a truth, against surveyed reference poses."""
