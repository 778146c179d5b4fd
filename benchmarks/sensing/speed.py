"""Speed of sensing: one block and many, compared with the memory and the paper's chain in scipy.

python -m benchmarks.sensing.speed
"""

import subprocess
import sysconfig
import tempfile
from pathlib import Path

import numpy as np
from scipy import signal

from benchmarks.rows import Row, medians
from benchmarks.sensing.accuracy import LSB_V, Case, config_of, scipy_chain
from haselab import _sense
from haselab.sensing import Lockin, PaperChain, SineFit
from haselab.sensing.block.plan import make_plan

GROUPS = 50  # of 60 blocks: 96 MB in float, far beyond the caches
FEW = 16  # blocks that stay in the second-level cache
SETS = {512: "AVX-512", 256: "AVX2", 128: "SSE2", 0: "plain C"}
COMMON = 256  # bits of the vectors that nearly all computers have


def read_bandwidth() -> tuple[float, float]:
    """GB/s from memory by one thread and by two, in C."""
    source = Path(__file__).parent / "read_bandwidth.c"
    compiler = (sysconfig.get_config_var("CC") or "cc").split()[0]
    with tempfile.TemporaryDirectory() as folder:
        program = Path(folder) / "read"
        subprocess.run([compiler, "-O3", "-pthread", str(source), "-o", str(program)], check=True)
        printed = subprocess.run([str(program)], check=True, capture_output=True, text=True).stdout
    one, two = (float(line) for line in printed.split())
    return one, two


def rows() -> list[Row]:
    case = Case("still", 0.05, 0.2)
    rng = np.random.default_rng(1)
    some = np.concatenate([case.record(rng) for _ in range(GROUPS // 10)])
    volts = np.tile(some, (10, 1, 1))
    single, codes = volts.astype(np.float32), np.round(volts / LSB_V).astype(np.int16)
    v, i = (np.ascontiguousarray(single[:, :, k]).ravel() for k in (0, 1))
    blocks = len(volts)
    lockin, paper = Lockin(config_of(case)), PaperChain(config_of(case))
    fit = SineFit(config_of(case))
    sections = signal.butter(4, 2001.0, fs=200e3, output="sos")
    out, few_out = np.empty(blocks, _sense.RESULT), np.empty(FEW, _sense.RESULT)
    native, few = lockin._native, np.ascontiguousarray(single[:FEW])
    common = make_plan(config_of(case), vectors=COMMON).native
    v_few, i_few = v[: FEW * 2000], i[: FEW * 2000]

    def one_by_one() -> None:
        for block in codes[:500]:
            lockin.step(block)

    def script() -> None:
        for block in volts[:200]:
            scipy_chain(block[np.newaxis], sections)

    def in_cache() -> None:
        for _ in range(100):
            _sense.blocks(native, few, few_out)

    def columns_in_cache(plan: _sense.Plan = native) -> None:
        for _ in range(100):
            _sense.channels(plan, v_few, i_few, few_out)

    one_gb, two_gb = read_bandwidth()
    (step_s, script_s, cache_s, flat_s, columns_s, alone_s, pairs_s, codes_s, scipy_s, paper_s) = (
        medians(
            one_by_one,
            script,
            in_cache,
            columns_in_cache,
            lambda: _sense.channels(native, v, i, out),
            lambda: _sense.channels(native, v, i, out, 1),
            lambda: _sense.blocks(native, single, out),
            lambda: _sense.blocks(native, codes, out),
            lambda: scipy_chain(some, sections),
            lambda: paper.sense(some),
        )
    )
    one_gb, two_gb = (max(a, b) for a, b in zip((one_gb, two_gb), read_bandwidth(), strict=True))
    (fit_s,) = medians(lambda: fit.sense(volts[:50]), rounds=3)
    block_us, cached_us = step_s / 500 * 1e6, cache_s / 100 / FEW * 1e6
    columns_gb = single.nbytes / columns_s / 1e9
    flat_256_s, columns_256_s, alone_256_s = medians(
        lambda: columns_in_cache(common),
        lambda: _sense.channels(common, v, i, out),
        lambda: _sense.channels(common, v, i, out, 1),
    )
    used, held = SETS[_sense.vectors()], SETS[min(COMMON, _sense.vectors())]
    slow_us = script_s / 200 * 1e6
    return [
        Row("one block of 10 ms, through Python", block_us, "us", 5.0, False),
        Row("one block in C, pairs", cached_us, "us", 1.0, False),
        Row("one block in C, columns", flat_s / 100 / FEW * 1e6, "us", 1.0, False, note=used),
        Row(f"   the same with {held}", flat_256_s / 100 / FEW * 1e6, "us", 1.0, False),
        Row(
            "bulk from memory over reading it, one thread",
            single.nbytes / alone_s / 1e9 / one_gb,
            "",
            0.8,
            note=f"reading {one_gb:.1f} GB/s, {used}",
        ),
        Row(
            f"   the same with {held}",
            single.nbytes / alone_256_s / 1e9 / one_gb,
            "",
            0.8,
        ),
        Row(
            f"   two threads with {held}",
            single.nbytes / columns_256_s / 1e9 / two_gb,
            "",
            0.8,
        ),
        Row(
            "   two threads",
            columns_gb / two_gb,
            "",
            0.8,
            note=f"reading {two_gb:.1f} GB/s",
        ),
        Row("bulk from memory, columns of float32", columns_gb, "GB/s"),
        Row("bulk from memory, pairs of float32", single.nbytes / pairs_s / 1e9, "GB/s"),
        Row("bulk from memory, ADC codes", codes.nbytes / codes_s / 1e9, "GB/s"),
        Row(
            "bulk over scipy's chain block by block",
            slow_us / (columns_s / blocks * 1e6),
            "times faster",
            100.0,
            note=f"scipy {slow_us:.0f} us a block",
        ),
        Row(
            "bulk over scipy's chain in bulk",
            scipy_s / len(some) / (columns_s / blocks),
            "times faster",
            note=f"scipy {scipy_s / len(some) * 1e6:.0f} us a block",
        ),
        Row("the paper's chain in C", paper_s / len(some) * 1e6, "us a block"),
        Row("sine fit, frequency refined", fit_s / 50 * 1e6, "us a block"),
    ]


def main() -> None:
    for row in rows():
        print(row)


if __name__ == "__main__":
    main()
