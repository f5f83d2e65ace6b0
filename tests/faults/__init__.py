"""Faults planted one at a time, to see whether the checks bite."""
