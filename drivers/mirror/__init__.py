"""Scanning mirrors on serial lines: `serial_mirror.SerialMirror`, and one module for each dialect."""
