"""Whether trajectories from anywhere are sound."""
