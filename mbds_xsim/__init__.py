"""Multibody simulation data you can trust: one neutral scene, four engines, cross-checked."""
