"""Runs that are measured: kept, judged, and searched for settings that are good enough."""
