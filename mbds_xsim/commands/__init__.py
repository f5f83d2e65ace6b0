"""The commands, a file each; importing one adds it to the command line."""

from mbds_xsim.commands import contact, listing, tradeoff, validate

__all__ = ["contact", "listing", "tradeoff", "validate"]
