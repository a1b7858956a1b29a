"""Handlers of pyserial for ports whose driver hangs, see `serial.protocol_handler_packages`."""
