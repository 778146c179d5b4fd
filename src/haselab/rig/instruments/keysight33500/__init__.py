"""Keysight 33500B function generators."""
