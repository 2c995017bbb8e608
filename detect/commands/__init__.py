"""The commands of the program `detect`: one module each, which reads files, computes and writes."""
