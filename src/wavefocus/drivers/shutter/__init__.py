"""Shutters and interlocks that block the laser beam; a driver is a module here."""
