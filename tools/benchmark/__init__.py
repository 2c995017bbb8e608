"""How fast the detectors are: side by side with decoding and with peers, on the same images."""
