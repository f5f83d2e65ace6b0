"""Studies: code that measures, analyses and presents results, mostly one folder per study."""
