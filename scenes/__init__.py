"""Built-in scenes: one family per file, and scene files found by name."""
