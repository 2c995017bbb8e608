"""The commands of the program `slam`: one module each, which reads files, computes and writes."""
