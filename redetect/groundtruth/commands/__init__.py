"""The commands of ``groundtruth``: a module each, its `perform` carries it out."""
