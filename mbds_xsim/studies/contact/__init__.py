"""What contact means in each engine."""
