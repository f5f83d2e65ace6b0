"""Models of other formats: each reader gives a scene and says what became of all that was read."""
