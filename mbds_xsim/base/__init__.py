"""Errors, files, processes, rotations: what every other part stands on."""
