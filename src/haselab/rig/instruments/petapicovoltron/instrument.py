"""`kind = "petapicovoltron"`: the high-voltage supply as an instrument of rig files."""

from __future__ import annotations

import os

from haselab.rig.drivers import load_driver
from haselab.rig.instruments.devices import SupplyDevice
from haselab.rig.instruments.instrument import OpenContext, SupplyInstrument, SystemNeeds
from haselab.rig.instruments.petapicovoltron.section import PetaPicoVoltronConfig
from haselab.rig.instruments.petapicovoltron.supply import (
    PetaPicoVoltron,
    identify_supply,
    switch_supply_off,
)

__all__ = ["PetaPicoVoltronInstrument"]


class PetaPicoVoltronInstrument(SupplyInstrument[PetaPicoVoltronConfig]):
    """High-voltage supplies of the Peta-Pico-Voltron family on a serial port."""

    kind = "petapicovoltron"
    config = PetaPicoVoltronConfig
    purpose = "high-voltage supplies on serial ports"

    def check_driver(self) -> list[str]:
        """See `Instrument`."""
        load_driver("serial", "The high-voltage supply")
        return ["serial"]

    def system_needs(self, config: PetaPicoVoltronConfig) -> SystemNeeds:
        """See `Instrument`."""
        return SystemNeeds(serial_ports=(config.port,))

    def identify(self, config: PetaPicoVoltronConfig) -> str:
        """See `Instrument`."""
        return identify_supply(config)

    def addresses(self, config: PetaPicoVoltronConfig) -> tuple[str, ...]:
        """See `OutputInstrument`."""
        return (os.path.realpath(config.port),)

    def shut_down(self, config: PetaPicoVoltronConfig, within_s: float) -> None:
        """See `OutputInstrument`; waits until the supply has discharged."""
        del within_s
        switch_supply_off(config)

    def open(self, config: PetaPicoVoltronConfig, context: OpenContext) -> SupplyDevice:
        """See `SupplyInstrument`."""
        del context
        return PetaPicoVoltron(config)
