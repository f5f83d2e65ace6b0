"""What is simulated: the neutral scene, its mechanism, its starts and inputs."""
