"""Sessions of a robot watched by fixed laser scanners and marker cameras, with exact truth."""
