"""The independent high-accuracy solution of a neutral scene."""
