"""What an adapter's author runs: the contract suite and the ladder of check cases."""
