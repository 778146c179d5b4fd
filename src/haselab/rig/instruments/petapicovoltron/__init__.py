"""Serial high-voltage supplies of the Peta-Pico-Voltron family."""
