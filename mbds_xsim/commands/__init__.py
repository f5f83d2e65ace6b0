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
)

__all__ = [
    "ablate",
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
]
