"""The simulated problem: the neutral scene, its mechanism, its starts and inputs."""
