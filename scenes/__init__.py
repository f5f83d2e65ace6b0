"""Built-in scenes: one family a file, and scene files found by name."""
