"""Instruments: the protocols of the roles and the drivers that implement them.

Public: `protocols` (roles, records, `DeviceIdentity`), `errors`, `registry` (drivers by name, `rig_key`), `process` (a
driver in a process of its own), `timeouts` (calls with an end).
"""
