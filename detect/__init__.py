"""From one image to landmarks, their comparison with a reference, the command line."""
