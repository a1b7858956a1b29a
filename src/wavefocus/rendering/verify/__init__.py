"""Verification: a drive played and scanned on the rig, and the scan compared with the prediction.

Public: `scan` (scan, Scan), `verdict` (compare, Verification), `record` (write_record, read_record, Figure) and
`field_pair` (read_pair, FieldPair).
"""
