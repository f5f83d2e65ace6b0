"""Learned simulators: graphs of scenes, models, their training and rollout. Needs torch."""
