"""Filling the templates of ``page/``: everything from a run is escaped, and nothing but our own script may run."""

from __future__ import annotations

import base64
import hashlib
import re
from functools import cache
from importlib import resources
from typing import Any

import jinja2
from markupsafe import Markup, escape

from tracking3d.results.description import versions

_OPTION = re.compile(r"(?<![\w-])--[a-z][a-z-]*[a-z]")


def render_page(template: str, scripts: tuple[str, ...] = (), **values: Any) -> bytes:
    """One self-contained HTML file, in UTF-8.

    Its content security policy allows the page's own script and style by their hashes and pictures within the page,
    and nothing else: no network, and no script injected through a value.

    Args:
        template: Name of a file in ``page/``.
        scripts: Names of files there, joined into one script.
        values: What the template needs; text is escaped where it is put in.
    """
    style, script = _file("style.css"), "\n".join(map(_file, scripts))
    policy = (
        "default-src 'none'; img-src data:; base-uri 'none'; form-action 'none'; "
        f"style-src '{_hash(style)}'; script-src '{_hash(script)}'"
    )
    page = _environment().get_template(template)
    version = versions()["tracking3d"] or ""
    text = page.render(style=Markup(style), script=Markup(script), policy=policy, version=version, **values)
    return text.encode("utf-8", "replace")


@cache
def _environment() -> jinja2.Environment:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("tracking3d.ui.report", "page"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["options_whole"] = _options_whole
    return environment


def _options_whole(text: str) -> Markup:
    """A sentence, escaped, whose options such as ``--fov`` are not broken over lines."""
    return Markup(_OPTION.sub(r'<span class="whole">\g<0></span>', str(escape(text))))


def _file(name: str) -> str:
    return (resources.files("tracking3d.ui.report") / "page" / name).read_text(encoding="utf-8")


def _hash(text: str) -> str:
    return f"sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}"
