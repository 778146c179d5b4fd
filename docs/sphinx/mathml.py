"""Formulas as MathML, which browsers draw themselves: no script, and nothing from another host."""

from __future__ import annotations

import html
import re

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx
from sphinx.util import logging
from sphinx.writers.html5 import HTML5Translator

_LOGGER = logging.getLogger(__name__)


def _mathml(node: nodes.Element, display: str) -> str:
    """The formula; one that cannot be converted is a warning, and its source is shown."""
    try:
        # As in TeX, an exponent after primes belongs to the primed symbol.
        return convert(re.sub(r"(\w'+)\^", r"{\1}^", node.astext()), display=display)
    except Exception as error:
        _LOGGER.warning("formula %r: %r", node.astext(), error, location=node)
        return f"<code>{html.escape(node.astext())}</code>"


def _inline(self: HTML5Translator, node: nodes.Element) -> None:
    self.body.append(_mathml(node, "inline"))
    raise nodes.SkipNode


def _block(self: HTML5Translator, node: nodes.Element) -> None:
    formula = _mathml(node, "block")
    self.body.append(f'<div class="math" tabindex="0">{formula}</div>\n')
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the renderer."""
    app.add_html_math_renderer("mathml", (_inline, None), (_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
