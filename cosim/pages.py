"""Pages of HTML from the templates: one file each that needs nothing else."""

from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from markupsafe import Markup

from .files import whole_file

_MISSING = "\N{EN DASH}"


def write_page(path: str | Path, template: str, figures: dict[str, str], **content: Any) -> None:
    """Render a template with its figures, SVG elements by name, whole or not at all. Raises OSError."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).with_name("templates")),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.filters |= {"number": number, "percent": percent}
    marked = {name: Markup(svg) for name, svg in figures.items()}
    html = environment.get_template(template).render(figures=marked, **content)
    with whole_file(Path(path)) as partial:
        partial.write_text(html, "utf-8")


def number(value: float | None, digits: int) -> str:
    """A number with its digits, a dash where there is none."""
    return _MISSING if value is None or not np.isfinite(value) else f"{value:.{digits}f}"


def percent(share: float | None, digits: int) -> str:
    """A share in percent."""
    return _MISSING if share is None or not np.isfinite(share) else f"{100 * share:.{digits}f} %"
