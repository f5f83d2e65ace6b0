"""Measured runs: stored, judged, and searched for settings that are good enough."""
