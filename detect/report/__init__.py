"""The page that tells what was found in a run, and how good it is."""
