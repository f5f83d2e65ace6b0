"""Readers and writers of other model formats, which report the fate of all they convert."""
