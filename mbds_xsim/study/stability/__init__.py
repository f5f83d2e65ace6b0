"""Where methods fail: sweeps across the edge of stability, one study a file."""
