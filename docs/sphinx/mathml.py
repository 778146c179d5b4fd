"""Formulas as MathML, which browsers draw themselves: no script, and nothing from another host."""

from __future__ import annotations

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx


def _inline(self, node: nodes.Element) -> None:  # noqa: ANN001 -- the translator of the builder
    self.body.append(convert(node.astext()))
    raise nodes.SkipNode


def _block(self, node: nodes.Element) -> None:  # noqa: ANN001
    formula = convert(node.astext(), display="block")
    self.body.append(f'<div class="math" tabindex="0">{formula}</div>\n')
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the renderer."""
    app.add_html_math_renderer("mathml", (_inline, None), (_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
