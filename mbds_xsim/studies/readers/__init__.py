"""What engines' own readers make of a model, held against what its file says."""
