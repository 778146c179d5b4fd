"""An emulated Keysight 33500B."""
