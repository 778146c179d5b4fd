"""A bench made safe from outside, over connections of its own, whoever holds the instruments."""

from __future__ import annotations

from collections.abc import Callable

from haselab.base import DeviceError
from haselab.rig.bench_config import BenchConfig
from haselab.rig.drivers import quietly
from haselab.rig.keysight33500 import KeysightGenerator
from haselab.rig.nidaq_link import reset_board
from haselab.rig.petapicovoltron import PetaPicoVoltron

__all__ = ["make_safe"]


def make_safe(config: BenchConfig) -> list[tuple[str, str]]:
    """Take every instrument to its rest; a fault of one does not keep the next from it.

    The board is reset, which aborts the tasks of every program and puts its outputs at their
    power-up state, 0 V. Generator and supply are off once they are opened, and are asked.

    Args:
        config: of the bench.
    Returns:
        For each instrument its name and what is wrong, empty where it is at rest.
    """
    acts: list[tuple[str, Callable[[], object]]] = [("daq", lambda: reset_board(config.daq))]
    supply = config.supply
    if supply is not None:
        acts.append(("supply", lambda: _rest_supply(PetaPicoVoltron(supply))))
    acts.append(("generator", lambda: _rest_generator(KeysightGenerator(config.generator))))
    told = [(name, quietly(act)) for name, act in acts]
    return [(name, "" if error is None else str(error)) for name, error in told]


def _rest_supply(supply: PetaPicoVoltron) -> None:
    try:
        supply.off()
        if not supply.is_off():
            raise DeviceError(f"the supply still has {supply.read_voltage():g} V")
    finally:
        supply.close()


def _rest_generator(generator: KeysightGenerator) -> None:
    try:
        generator.off()
        if not generator.is_off():
            raise DeviceError("the output is on after OUTP OFF")
    finally:
        generator.close()
