"""The second board, a small Cortex-M: what its compiler made, and its code on this machine."""

from __future__ import annotations

import json
import re
import struct
import subprocess
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import pytest

from haselab.base import InputError
from haselab.cli.main import main
from haselab.firmware import ChipSettings, FrontEnd, settings_header
from haselab.rig.chip import (
    Firmware,
    board_names,
    build_firmware,
    find_tool,
    load_board,
    read_design,
    source_folder,
)

HERE = Path(__file__).resolve().parent
ROOT = source_folder()
BOARD = ROOT / "firmware/board/stm32g071"
CORE = sorted((ROOT / "core").glob("*.c"))
APP = sorted((ROOT / "firmware/app").glob("*.c"))
SANITIZE = ["-g", "-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
NAME = "stm32g071"
FLASH_BYTES = 16 * 1024
RAM_BYTES = 2 * 1024  # with the stack's room
CYCLES = 16_000  # of a frame
EXCEPTION_BYTES = 32 + 4  # that an interrupt stacks, aligned to 8
EXCEPTION_CYCLES = 15 + 17  # into it (Cortex-M0+ manual, 15) and back
OUTPUT_CYCLES = 32  # 16 bits to the output's converter, which memory does not wait for

# Reference manual RM0444, table 6 (memory map), and the ARMv6-M architecture manual, B3.4.
ADDRESSES = {
    "TIM2": 0x4000_0000, "TIM3": 0x4000_0400, "TIM14": 0x4000_2000, "IWDG": 0x4000_3000,
    "USART2": 0x4000_4400, "ADC1": 0x4001_2400, "SPI1": 0x4001_3000, "RCC": 0x4002_1000,
    "GPIOA": 0x5000_0000, "GPIOB": 0x5000_0400, "NVIC": 0xE000_E100,
}  # fmt: skip


@dataclass(frozen=True)
class Program:
    """What binutils tell of a program."""

    elf: Path

    def _told(self, tool: str, *options: str) -> list[str]:
        command = [f"arm-none-eabi-{tool}", *options, str(self.elf)]
        return subprocess.run(
            command, capture_output=True, text=True, check=True
        ).stdout.splitlines()

    @cached_property
    def symbols(self) -> dict[str, int]:
        rows = [line.split() for line in self._told("nm")]
        return {row[-1]: int(row[0], 16) for row in rows if len(row) == 3}

    @cached_property
    def undefined(self) -> list[str]:
        return self._told("nm", "-u")

    @cached_property
    def functions(self) -> dict[str, list[tuple[int, str, str]]]:
        """Name -> address, instruction, operands."""
        found: dict[str, list[tuple[int, str, str]]] = {}
        rows: list[tuple[int, str, str]] = []
        for line in self._told("objdump", "-d", "--no-show-raw-insn"):
            head = re.match(r"[0-9a-f]+ <(.+)>:", line)
            if head:
                rows = found.setdefault(head[1], [])
            row = re.match(r"\s+([0-9a-f]+):\t(\S+)\s*([^@;]*)", line)
            if row:
                rows.append((int(row[1], 16), row[2].removesuffix(".n"), row[3].strip()))
        return found

    def calls(self, name: str) -> set[str]:
        """Functions that it calls, or ends in."""
        found = set()
        for _, what, operands in self.functions[name]:
            assert what != "blx", f"{name} calls through a pointer: {operands}"
            to = re.search(r"<([^+>]+)>", operands)
            if to and (what == "bl" or (what.startswith("b") and to[1] != name)):
                found.add(to[1])
        return found

    def depth(self, name: str, above: tuple[str, ...] = ()) -> int:
        """Bytes of stack that a call of it takes at most."""
        assert name not in above, f"{name} calls itself by way of {above}"
        own = 0
        for _, what, operands in self.functions[name]:
            if what == "push":
                own += 4 * _registers(operands)
            elif what == "sub" and operands.startswith("sp,"):
                own += int(re.search(r"#(\d+)", operands)[1])  # type: ignore[index]
            else:
                assert not re.match(r"(add|mov|msr)", what) or not re.match(
                    r"(sp, [^#]|[mp]sp)", operands.lower()
                ), f"{name}: the stack moves by {operands}"
        below = [self.depth(callee, (*above, name)) for callee in self.calls(name)]
        return own + max(below, default=0)


def _registers(operands: str) -> int:
    count = 0
    for part in operands[operands.index("{") + 1 : operands.index("}")].split(","):
        low, _, high = part.strip().partition("-")
        count += int(high[1:]) - int(low[1:]) + 1 if high else 1
    return count


def cycles_of(what: str, operands: str, *, goes_on: bool) -> int:
    """Of the Cortex-M0+ without wait states (its manual, table 3-1)."""
    if what in ("push", "pop", "ldmia", "stmia"):
        return _registers(operands) + (3 if "pc" in operands else 1)
    if what.startswith(("ldr", "str")):
        return 2
    if what in ("bl", "mrs", "msr", "dmb", "dsb", "isb"):
        return 3
    if what in ("b", "bx") or operands.startswith("pc,"):
        return 2
    if re.fullmatch(r"b(eq|ne|cs|cc|mi|pl|vs|vc|hi|ls|ge|lt|gt|le)", what):
        return 1 if goes_on else 2
    return 1


@pytest.fixture(scope="module")
def own_settings() -> ChipSettings:
    """Of the same study, for this board's converter."""
    return read_design(HERE.parent / "data", "pid", load_board(NAME).front_end).settings


@pytest.fixture(scope="module")
def built(own_settings: ChipSettings, tmp_path_factory: pytest.TempPathFactory) -> Firmware:
    try:
        return build_firmware(own_settings, tmp_path_factory.mktemp(NAME), NAME)
    except InputError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def program(built: Firmware) -> Program:
    return Program(built.elf)


# ---- on this machine ----


@pytest.mark.parametrize(
    ("name", "with_firmware"), [("test_board_stm32g071", False), ("test_whole_stm32g071", True)]
)
def test_the_board_passes_its_host_tests_under_the_sanitizers(
    name: str,
    with_firmware: bool,
    own_settings: ChipSettings,
    host: Callable[..., Path],
    tmp_path: Path,
) -> None:
    (tmp_path / "settings.h").write_text(settings_header(own_settings), encoding="ascii")
    more = ["-Dmain=firmware_main", *map(str, (*CORE, *APP))] if with_firmware else []
    test = host(name, [HERE / f"{name}.c"], *SANITIZE, f"-I{tmp_path}", f"-I{BOARD}", *more)
    done = subprocess.run([str(test)], capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr


def test_cppcheck_and_clang_tidy_find_nothing_in_the_board(
    own_settings: ChipSettings, tmp_path: Path, installed: Callable[[str, str], str]
) -> None:
    (tmp_path / "settings.h").write_text(settings_header(own_settings), encoding="ascii")
    include = [f"-I{path}" for path in (ROOT / "core/include", ROOT / "firmware/app",
                                        ROOT / "firmware/protocol", tmp_path)]  # fmt: skip
    for command in (
        [installed("cppcheck", "cppcheck"),
         "--platform=unix32", "--std=c99", "--error-exitcode=1", "--quiet",
         "--enable=warning,style,performance,portability", "--inline-suppr",
         "--suppress=missingIncludeSystem", "--suppress=unusedStructMember", *include, str(BOARD)],
        [installed("clang-tidy", "clang-tidy"), "-quiet", "-warnings-as-errors=*",
         "-checks=-*,clang-analyzer-*,bugprone-*,-bugprone-easily-swappable-parameters",
         str(BOARD / "board.c"), "--", "-std=c99", *include],
    ):  # fmt: skip
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
        assert done.returncode == 0, done.stdout + done.stderr


# ---- what the compiler made ----


def test_flash_and_ram_stay_within_their_budgets(built: Firmware, program: Program) -> None:
    stack = program.symbols["stack_end"] - program.symbols["stack_start"]
    assert 4096 < built.flash_bytes < FLASH_BYTES
    assert built.static_bytes > 256
    assert built.static_bytes + stack < RAM_BYTES
    # Nothing lies below the stack: one that is too small faults, and writes into no variable.
    assert program.symbols["stack_start"] == 0x2000_0000
    assert program.symbols["ram_end"] <= 0x2000_8000
    assert built.hex.read_text(encoding="ascii").startswith(":020000040800F2\n")  # at 0x0800....


def test_the_deepest_stack_has_room_and_nothing_calls_itself_or_through_a_pointer(
    program: Program,
) -> None:
    room = program.symbols["stack_end"] - program.symbols["stack_start"]
    # Sampling interrupts the link, which interrupts the main program.
    deepest = sum(program.depth(name) for name in ("reset", "board_link", "board_sample"))
    deepest += 2 * EXCEPTION_BYTES
    assert 100 < deepest <= room // 2, deepest
    for name in program.functions:
        program.depth(name)


def test_the_firmware_uses_no_heap_no_libm_and_no_library_but_the_compilers(
    program: Program,
) -> None:
    names = set(program.symbols)
    assert not names & {"malloc", "free", "realloc", "sbrk", "expf", "sqrtf", "printf", "memcpy"}
    assert not program.undefined
    assert not [name for name in names if name.startswith("__aeabi_d")]  # doubles


def test_the_vectors_are_those_of_the_two_interrupts_and_the_rest_faults(
    built: Firmware, program: Program, tmp_path: Path
) -> None:
    image = tmp_path / "image"
    subprocess.run(
        ["arm-none-eabi-objcopy", "-O", "binary", str(built.elf), str(image)], check=True
    )
    vectors = struct.unpack_from("<47I", image.read_bytes())
    at = program.symbols
    assert at["vector_table"] == 0x0800_0000
    named = {0: at["stack_end"], 1: at["reset"] | 1,
             16 + 16: at["board_sample"] | 1, 16 + 28: at["board_link"] | 1}  # fmt: skip
    assert vectors == tuple(named.get(k, at["fault"] | 1) for k in range(47))


def test_the_units_lie_where_the_manual_puts_them(program: Program) -> None:
    assert {name: program.symbols[name] for name in ADDRESSES} == ADDRESSES


def test_the_output_is_made_safe_before_anything_else_happens(program: Program) -> None:
    ahead = []
    for _, what, operands in program.functions["reset"]:
        if what == "bl":
            assert "<board_early>" in operands
            break
        ahead.append(what)
    assert set(ahead) <= {"push", "sub", "mov"}, ahead
    # And the pin is low before it becomes an output: the data register is written first.
    stores = [operands for _, what, operands in program.functions["board_early"] if what == "str"]
    ports = [offset for offset in (re.search(r"#(\d+)\]", text) for text in stores) if offset]
    order = [int(offset[1]) for offset in ports]
    assert order.index(20) < order.index(0), stores


# ---- the same bits, and how long they take ----


@pytest.fixture(scope="module")
def replay(settings: ChipSettings, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The board, app and core as its compiler makes them, on the kept updates' settings."""
    board = load_board(NAME)
    try:
        compiler = find_tool(f"{board.prefix}gcc", board.package)
        find_tool("qemu-arm", "qemu-user")
    except InputError as error:
        pytest.skip(str(error))
    folder = tmp_path_factory.mktemp("replay")
    (folder / "settings.h").write_text(settings_header(settings), encoding="ascii")
    include = [f"-I{path}" for path in (ROOT / "core/include", ROOT / "firmware/app",
                                        ROOT / "firmware/protocol", BOARD, folder)]  # fmt: skip
    sources = [*CORE, *(path for path in APP if path.name != "main.c"), BOARD / "board.c",
               HERE / "replay_arm.c"]  # fmt: skip
    strict = ["-std=c99", "-ffp-contract=off", "-Wall", "-Wextra", "-Wconversion", "-Werror"]
    flags = [flag for flag in board.flags if flag != "-flto"]  # functions stay what they are
    done = subprocess.run(
        [compiler, *strict, *flags, *include, *map(str, sources), "-lgcc", "-o",
         str(folder / "replay")],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return folder / "replay"


def kept() -> list[list[str]]:
    text = (HERE.parent / "data/trace.txt").read_text(encoding="ascii")
    return [line.split(" | ") for line in text.splitlines()]


def records(rows: list[list[str]]) -> bytes:
    words = [row[0].split() for row in rows]
    return b"".join(
        struct.pack("<8H2BHI", *map(int, word[:10]), 0, int(word[10], 16)) for word in words
    )


# ARMv6, so that an instruction of larger cores is refused.
EMULATOR = ["qemu-arm", "-cpu", "arm1176"]


def test_a_thousand_kept_updates_are_the_atmega2560s_bit_by_bit(replay: Path) -> None:
    rows = kept()
    reported = subprocess.run(
        [*EMULATOR, str(replay)], input=records(rows), capture_output=True, check=True, timeout=300
    ).stdout
    found = [
        f"{state} {code} {strain:08x} {corrected:08x}"
        for state, code, strain, corrected in struct.iter_unpack("<2H2I", reported)
    ]
    assert len(found) == len(rows) == 1000
    # The first window reaches back to readings from before the first trace.
    assert found[1:] == [answer for _, answer in rows][1:]


def test_an_update_with_its_interrupts_leaves_a_quarter_of_the_frame(replay: Path) -> None:
    """Instructions as they were carried out, cycles by the processor's manual."""
    updates, interrupts = counted(replay, records(kept()[:200]))
    assert len(updates) == 200
    assert len(interrupts) == 8 * 200
    frames = [
        sum(cycles + EXCEPTION_CYCLES for cycles in interrupts[8 * k : 8 * k + 8])
        for k in range(200)
    ]
    total = [a + b + OUTPUT_CYCLES for a, b in zip(updates, frames, strict=True)]
    # The loop is closed for the second half: floats of PID, map and table.
    assert 5000 < sum(total[100:]) / 100 < 0.6 * CYCLES, sum(total[100:]) / 100
    assert max(total) < 0.75 * CYCLES, (max(total), max(updates), max(interrupts))


def counted(replay: Path, data: bytes) -> tuple[list[int], list[int]]:
    program = Program(replay)
    at = program.symbols
    costs = {row[0]: row[1:] for rows in program.functions.values() for row in rows}
    run = subprocess.run(
        [*EMULATOR, "-singlestep", "-d", "exec,nochain", str(replay)],
        input=data, capture_output=True, check=True, timeout=300,
    )  # fmt: skip
    updates: list[int] = []
    interrupts: list[int] = []
    passed, until, last = 0, 0, 0
    for match in re.finditer(rb"^Trace .*\[[0-9a-f]+/([0-9a-f]+)/", run.stderr, re.MULTILINE):
        pc = int(match[1], 16)
        if until:
            passed += cycles_of(*costs[last], goes_on=pc == last + 2)
        if pc == until:
            (updates if pc == at["mark_end"] else interrupts).append(passed)
            until = 0
        elif pc == at["mark_update"]:
            passed, until = 0, at["mark_end"]
        elif pc == at["board_sample"]:
            passed, until = 0, last + 4
        last = pc
    return updates, interrupts


# ---- boards ----


def test_a_board_is_a_folder_and_the_atmega2560_is_the_default_front_end() -> None:
    assert board_names() == ["atmega2560", NAME]
    assert load_board("atmega2560").front_end == FrontEnd()
    small, large = load_board(NAME).front_end, FrontEnd()
    # The same share of each range: both stages shrink with the converter's range.
    for stage in ("v_stage", "i_stage"):
        share = getattr(small, stage) / getattr(large, stage)
        assert share == pytest.approx(small.converter_v / large.converter_v, rel=0.01)


def test_settings_of_another_converter_and_unknown_boards_are_refused(
    settings: ChipSettings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(InputError, match=r"1024 codes over 5 V, but stm32g071 has 4096 codes over"):
        build_firmware(settings, tmp_path, NAME)
    with pytest.raises(InputError, match=r"no board 'uno'\. Choose one of atmega2560, stm32g071"):
        load_board("uno")
    folder = tmp_path / "firmware/board/mine"
    folder.mkdir(parents=True)
    monkeypatch.setattr("haselab.rig.chip.boards.source_folder", lambda: tmp_path)
    for text, match in (
        ('prefix = "x-"\nflags = []\n', "lacks or misuses 'package'"),
        ('prefix = "x-"\npackage = "x"\nflags = []\nflag = 1\n', "misuses 'flag'"),
        ('prefix = "x-"\npackage = "x"\nflags = []\n[front_end]\nbits = 12\n', "'bits'"),
        ("prefix = \n", "board.toml lacks or misuses"),
    ):
        (folder / "board.toml").write_text(text, encoding="utf-8")
        with pytest.raises(InputError, match=match):
            load_board("mine")


def test_the_command_builds_for_a_board(
    built: Firmware, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["firmware", "build", str(HERE.parent / "data"), "--board", NAME, "--build-dir",
              str(tmp_path), "--json"])  # fmt: skip
    assert stop.value.code == 0
    assert json.loads(capsys.readouterr().out)["flash_bytes"] == built.flash_bytes
    with pytest.raises(SystemExit) as stop:
        main(["firmware", "build", str(HERE.parent / "data"), "--board", "uno"])
    assert stop.value.code == 2
    assert "Choose one of atmega2560, stm32g071" in capsys.readouterr().err
