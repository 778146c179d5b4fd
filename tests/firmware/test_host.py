"""The firmware's parts on this machine, under the sanitizers; what the chip's compiler made."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from haselab.firmware import ChipSettings, settings_header
from haselab.rig.chip import Firmware, source_folder

ROOT = source_folder()
HERE = Path(__file__).resolve().parent
CORE = sorted((ROOT / "core").glob("*.c"))
APP = [ROOT / "firmware/app" / name for name in ("app.c", "controller_pid.c", "link.c", "frame.c")]
SANITIZE = ["-g", "-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]


@pytest.mark.parametrize("name", ["test_app", "test_link", "test_sampler"])
def test_host_tests_pass_under_the_sanitizers(name: str, host: Callable[..., Path]) -> None:
    program = host(name, [HERE / f"{name}.c", *CORE, *APP], *SANITIZE)
    done = subprocess.run([str(program)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_the_firmware_uses_no_heap_no_libm_and_never_calls_itself(firmware: Firmware) -> None:
    symbols = subprocess.run(
        ["avr-nm", str(firmware.elf)], capture_output=True, text=True, check=True
    ).stdout
    names = {line.split()[-1] for line in symbols.splitlines()}
    assert not names & {"malloc", "free", "realloc", "alloca", "expf", "exp", "sqrt", "printf"}
    listing = subprocess.run(
        ["avr-objdump", "-d", str(firmware.elf)], capture_output=True, text=True, check=True
    ).stdout
    calls: dict[str, set[str]] = {}
    name = ""
    for line in listing.splitlines():
        head = re.match(r"[0-9a-f]+ <(.+)>:", line)
        if head:
            name = head[1]
            calls.setdefault(name, set())
        called = re.search(r"\tr?call\t.*<([^+>]+)>", line)
        if called:
            calls[name].add(called[1])
        assert not re.search(r"\te?icall\b", line), f"a call through a pointer: {line}"
    # The compiler's float routines, in assembler, enter one another halfway: left out.
    for start in (name for name in calls if not name.startswith("__fp_")):
        seen: set[str] = set()
        waiting = list(calls[start])
        while waiting:
            one = waiting.pop()
            assert one != start, f"{start} calls itself by way of {seen}"
            if one not in seen:
                seen.add(one)
                waiting += calls.get(one, ())


def test_cppcheck_finds_nothing_in_the_firmware(
    settings: ChipSettings, tmp_path: Path, installed: Callable[[str, str], str]
) -> None:
    (tmp_path / "settings.h").write_text(settings_header(settings), encoding="ascii")
    include = [f"-I{path}" for path in (ROOT / "core/include", ROOT / "firmware/app",
                                        ROOT / "firmware/protocol", tmp_path)]  # fmt: skip
    done = subprocess.run(
        [installed("cppcheck", "cppcheck"),
         "--platform=avr8", "--std=c99", "--error-exitcode=1", "--quiet",
         "--enable=warning,style,performance,portability", "--inline-suppr",
         "--suppress=missingIncludeSystem", "--suppress=unusedFunction",
         "--suppress=unusedStructMember", *include,
         str(ROOT / "firmware/app"), str(ROOT / "firmware/board/atmega2560")],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr


def test_clang_tidy_finds_nothing_in_the_firmware(
    settings: ChipSettings, tmp_path: Path, installed: Callable[[str, str], str]
) -> None:
    (tmp_path / "settings.h").write_text(settings_header(settings), encoding="ascii")
    include = [f"-I{path}" for path in (ROOT / "core/include", ROOT / "firmware/app",
                                        ROOT / "firmware/protocol", tmp_path)]  # fmt: skip
    checks = "-*,clang-analyzer-*,bugprone-*,-bugprone-easily-swappable-parameters"
    sources = [str(path) for path in (*CORE, *sorted((ROOT / "firmware/app").glob("*.c")))]
    done = subprocess.run(
        [installed("clang-tidy", "clang-tidy"),
         "-quiet", "-warnings-as-errors=*", f"-checks={checks}", *sources,
         "--", "-std=c99", *include],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout
