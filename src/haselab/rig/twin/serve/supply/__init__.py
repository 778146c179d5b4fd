"""An emulated Peta-Pico-Voltron supply."""
