"""The commands of ``groundtruth``: each is a module whose `perform` executes it."""
