"""What `import redetect` offers: typed results round the functions of the other packages."""
