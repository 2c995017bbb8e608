"""The commands of the program `camera`: one module each."""
