"""Pages from the templates of this folder, which escape whatever text they are given."""

from __future__ import annotations

from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from mbds_xsim.report import palette
from mbds_xsim.safe_text import printable, sentence

__all__ = ["rendered"]


def rendered(template: str, **values: Any) -> str:
    """Fill a template."""
    environment = Environment(
        loader=PackageLoader("mbds_xsim", "report"),
        autoescape=True,
        undefined=StrictUndefined,
        finalize=_finalized,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["sentence"] = sentence
    colours = {"light": palette.LIGHT, "dark": palette.DARK}
    return environment.get_template(template).render(**colours, **values)


def _finalized(value: Any) -> Any:
    """Drop control characters; text that is HTML already stays so."""
    return type(value)(printable(value)) if isinstance(value, str) else value
