"""Commands, grouped by purpose; importing a file adds its commands to the command line."""

from importlib import import_module
from pkgutil import iter_modules

from mbds_xsim.commands.shared import app

__all__ = ["app"]

for _module in iter_modules(__path__, f"{__name__}."):
    import_module(_module.name)
