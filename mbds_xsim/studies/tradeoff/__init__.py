"""Speed against accuracy."""
