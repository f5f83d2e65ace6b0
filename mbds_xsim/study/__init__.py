"""Studies: what engines do, measured on purpose-made scenes and written into the docs."""
