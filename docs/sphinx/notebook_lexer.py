"""Colours for cells of notebooks in which a line for the shell goes on after a backslash."""

from __future__ import annotations

from ipython_pygments_lexers import IPython3Lexer
from pygments.lexer import bygroups, using
from pygments.lexers.shell import BashLexer
from pygments.token import Operator, Text
from sphinx.application import Sphinx

_SHELL = (
    r"^([ \t]*)(!)((?:[^\n]*\\\n)*[^\n]*\n)",
    bygroups(Text, Operator, using(BashLexer)),
)


class NotebookLexer(IPython3Lexer):
    """IPython's lexer, which takes a line for the shell to end with its first line."""

    tokens = {**IPython3Lexer.tokens, "root": [_SHELL, *IPython3Lexer.tokens["root"]]}  # noqa: RUF012


def setup(app: Sphinx) -> dict[str, bool]:
    """Use the lexer for all cells."""
    app.add_lexer("ipython3", NotebookLexer)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
