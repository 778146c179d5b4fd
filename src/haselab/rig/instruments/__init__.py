"""Drivers of instruments, one file each."""
