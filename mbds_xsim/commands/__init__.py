"""The commands, a file each; importing one adds it to the command line."""

from mbds_xsim.commands import contact, listing, validate

__all__ = ["contact", "listing", "validate"]
