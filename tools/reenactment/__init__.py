"""From a recorded run's landmark file to the world that it was recorded in, for rendering it."""
