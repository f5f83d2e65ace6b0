"""The commands, a file each; importing one adds it to the command line."""

from mbds_xsim.commands import (
    ablate,
    audit,
    contact,
    diff,
    export,
    generate,
    inspect,
    listing,
    match,
    plan,
    shift,
    stability,
    tradeoff,
    train,
    validate,
    verify,
    version,
)
from mbds_xsim.commands.shared import app

__all__ = [
    "ablate",
    "app",
    "audit",
    "contact",
    "diff",
    "export",
    "generate",
    "inspect",
    "listing",
    "match",
    "plan",
    "shift",
    "stability",
    "tradeoff",
    "train",
    "validate",
    "verify",
    "version",
]
