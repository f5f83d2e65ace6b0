"""Studies, a folder each: what is measured, what it comes to, how it is presented."""
