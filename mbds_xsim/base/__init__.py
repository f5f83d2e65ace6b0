"""Errors, files, processes and rotations, used by every other part."""
