"""Checks that read only what is published: scene, inputs and trajectory."""
