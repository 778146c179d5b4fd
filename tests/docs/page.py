"""The commands and the Python code of a page of docs, to run as they are written there."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import Any

from haselab.cli.main import cli

_DOCS = Path(__file__).resolve().parents[2] / "docs"
_BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)


class Page:
    """One page of docs.

    Args:
        name: of its file in docs.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.text = (_DOCS / name).read_text(encoding="utf-8")
        blocks = _BLOCK.findall(self.text)
        #: Lines of the blocks without a language.
        self.commands: list[str] = [
            line for language, code in blocks if not language for line in code.splitlines()
        ]
        #: Blocks in Python.
        self.python: list[str] = [code for language, code in blocks if language == "python"]
        #: Blocks in TOML.
        self.toml: list[str] = [code for language, code in blocks if language == "toml"]
        #: Lines of the blocks in `sh`: commands that need a second terminal, or a browser.
        self.terminal: list[str] = [
            line for language, code in blocks if language == "sh" for line in code.splitlines()
        ]

    def run(self, command: str) -> None:
        """Run one command line in this process. What it is to write must not be empty."""
        program, *arguments = shlex.split(command)
        assert program == "haselab", command
        cli.main(args=arguments, prog_name=program, standalone_mode=False)
        if "--out" in arguments:
            assert Path(arguments[arguments.index("--out") + 1]).stat().st_size > 0, command

    def execute(self, code: str, names: dict[str, Any] | None = None) -> dict[str, Any]:
        """Run a block of Python, whose fits must have a result; its names afterwards."""
        found = {} if names is None else names
        exec(compile(code, self.name, "exec"), found)
        for name, value in found.items():
            assert getattr(value, "status", "ok") == "ok", f"{name} of {self.name}"
        return found
