"""Learned models under a change of engine."""
