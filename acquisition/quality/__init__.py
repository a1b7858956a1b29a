"""Point quality: defects, limits, drift, watched conditions."""
