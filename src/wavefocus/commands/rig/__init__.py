"""Commands about instruments: examined, calibrated, operated by hand, emulated."""
