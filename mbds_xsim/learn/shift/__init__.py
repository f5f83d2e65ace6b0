"""The engine-shift study: models trained on one engine's data, tested on every other's."""
