"""Simulation: the contract of adapters, their registry, settings and read-back."""
