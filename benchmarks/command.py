"""Start of the command line, compared with the bare interpreter: `python -m benchmarks.command`."""

import subprocess
import sys
from collections.abc import Callable

from benchmarks.rows import Row, medians


def rows() -> list[Row]:
    def run(*arguments: str) -> Callable[[], object]:
        return lambda: subprocess.run([sys.executable, *arguments], check=True, capture_output=True)

    help_s, bare_s = medians(run("-m", "haselab.cli", "--help"), run("-c", "pass"), rounds=5)
    note = f"the interpreter alone {bare_s:.2f}"
    return [Row("haselab --help", help_s, "s", 0.4, False, note)]


if __name__ == "__main__":
    for row in rows():
        print(row)
