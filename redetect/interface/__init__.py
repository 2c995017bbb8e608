"""The API of `import redetect`: typed results around the functions of the other packages."""
