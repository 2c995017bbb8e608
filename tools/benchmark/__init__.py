"""The speed of the detectors compared with decoding and with peers, on the same images."""
