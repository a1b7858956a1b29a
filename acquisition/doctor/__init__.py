"""The doctor: every instrument opened, identified and exercised; `examine` a `RigUnderTest`."""
