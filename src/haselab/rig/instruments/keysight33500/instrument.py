"""`kind = "keysight33500"`: the function generator as an instrument of rig files."""

from __future__ import annotations

from haselab.rig.drivers import load_driver
from haselab.rig.instruments.devices import GeneratorDevice
from haselab.rig.instruments.instrument import GeneratorInstrument, OpenContext
from haselab.rig.instruments.keysight33500.generator import (
    KeysightGenerator,
    identify_generator,
    switch_generator_off,
)
from haselab.rig.instruments.keysight33500.section import KeysightConfig

__all__ = ["KeysightInstrument"]


class KeysightInstrument(GeneratorInstrument[KeysightConfig]):
    """Keysight 33500B over VISA."""

    kind = "keysight33500"
    config = KeysightConfig
    packages = ("PyVISA", "PyVISA-py", "PyMeasure")
    purpose = "function generators"
    shutdown_attempts = 1  # it accepts few connections, and `shut_down` retries by itself

    def check_driver(self) -> list[str]:
        """See `Instrument`."""
        for module in ("pyvisa", "pyvisa_py", "pymeasure.instruments.agilent"):
            load_driver(module, "The function generator")
        return ["pymeasure", "pyvisa_py"]

    def identify(self, config: KeysightConfig) -> str:
        """See `Instrument`."""
        return identify_generator(config)

    def addresses(self, config: KeysightConfig) -> tuple[str, ...]:
        """See `OutputInstrument`."""
        return (config.address,)

    def shut_down(self, config: KeysightConfig, within_s: float) -> None:
        """See `OutputInstrument`: one short connection, one line."""
        switch_generator_off(config, within_s)

    def open(self, config: KeysightConfig, context: OpenContext) -> GeneratorDevice:
        """See `GeneratorInstrument`."""
        del context
        return KeysightGenerator(config)
