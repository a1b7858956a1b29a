"""Ledger files, what banks and raw recordings have in common: rows under checksums, one writer, any readers.

HDF5 lays a file out once, with all its space reserved. The writer then writes at stated offsets: the data of a
position, sync, its ledger row with their checksums, sync. Only where both hold does the position count.
"""
