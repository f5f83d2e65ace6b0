"""No more than a scene needs."""
