"""Pages of HTML that hold all they show: no network, scripts or fonts of others."""

import base64
from typing import Any

from wavefocus.rendering.number_text import number, precise


def html_page(template: str, package: str = "wavefocus.rendering", /, **content: Any) -> str:
    """Fill a template from a package's folder ``templates``; it may extend those of ``rendering``."""
    from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined

    loader = ChoiceLoader([PackageLoader(name) for name in dict.fromkeys((package, "wavefocus.rendering"))])
    environment = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True)
    environment.filters |= {
        "number": number,
        "precise": precise,
        "base64": lambda png: base64.b64encode(png).decode("ascii"),
    }
    return environment.get_template(template).render(**content)
