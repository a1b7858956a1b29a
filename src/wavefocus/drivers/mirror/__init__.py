"""Scanning mirrors: one module for each dialect; those on serial lines use `wavefocus.drivers.serial_device`."""
