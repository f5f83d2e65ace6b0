"""The commands, a file each; importing one adds it to the command line."""

from mbds_xsim.commands import (
    contact,
    generate,
    listing,
    match,
    stability,
    tradeoff,
    validate,
    verify,
)

__all__ = ["contact", "generate", "listing", "match", "stability", "tradeoff", "validate", "verify"]
