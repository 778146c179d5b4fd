"""One MATLAB struct with named fields, in a file of version 5."""

from __future__ import annotations

import pickle
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import loadmat, savemat

from haselab.base import InputError, JsonObject
from haselab.store.folder import drafted
from haselab.store.text_file import check_regular

__all__ = ["read_mat_struct", "write_mat_struct", "write_mat_structs"]


def write_mat_struct(path: Path, name: str, fields: Mapping[str, Any]) -> None:
    """Write one struct; vectors become rows.

    Args:
        path: of the file.
        name: of the variable.
        fields: numbers, vectors, text.
    """
    write_mat_structs(path, {name: fields})


def write_mat_structs(path: Path, structs: Mapping[str, Mapping[str, Any]]) -> None:
    """Write several structs; vectors become rows.

    Args:
        path: of the file.
        structs: fields of each: numbers, arrays, text.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    plain = {name: dict(fields) for name, fields in structs.items()}
    with drafted(path) as draft, draft.open("wb") as file:
        savemat(file, plain, format="5", oned_as="row", appendmat=False)


def read_mat_struct(path: Path, name: str) -> JsonObject:
    """Fields of one struct: text as text, all else as arrays.

    Args:
        path: of the file.
        name: of the variable; a file with one struct may call it otherwise.
    Raises:
        InputError: not of version 5, or no such struct.
    """
    check_regular(path)
    good, content = _loaded_aside(path)
    if not good:
        raise InputError(
            f"The file is not a MATLAB file of version 5 ({' '.join(str(content).split())[:80]}). "
            f"Save it with -v6 or -v7: {path}"
        )
    structs = {key: value for key, value in content.items() if isinstance(value, dict)}
    chosen = structs.get(name, next(iter(structs.values())) if len(structs) == 1 else None)
    if chosen is None:
        found = ", ".join(key for key in content if not key.startswith("__")) or "nothing"
        raise InputError(
            f"The file has the variables {found}, but no struct {name!r}. Save the struct with "
            f"that name: {path}"
        )
    return {key: v if isinstance(v, str) else np.asarray(v) for key, v in chosen.items()}


def _loaded_aside(path: Path) -> tuple[bool, Any]:
    """Read the file's variables in a separate process; return them, or the error.

    scipy's compiled reader crashes on some damaged files; here only the separate process ends.
    """
    command = [sys.executable, "-m", __name__, str(path)]
    done = subprocess.run(command, capture_output=True, check=False)
    if done.returncode != 0:
        return False, f"its reader ended with status {done.returncode}"
    answer: tuple[bool, Any] = pickle.loads(done.stdout)
    return answer


def _main() -> None:
    answer: tuple[bool, Any]
    try:
        with Path(sys.argv[1]).open("rb") as stream:
            answer = True, loadmat(stream, simplify_cells=True)
    except Exception as error:  # the library raises anything about a damaged file
        answer = False, str(error)
    sys.stdout.buffer.write(pickle.dumps(answer))


if __name__ == "__main__":
    _main()
