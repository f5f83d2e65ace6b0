"""Which engines to trust with a scene."""
