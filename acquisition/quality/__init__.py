"""Point quality: defects by name, judgement, neighbours, drift, watched conditions."""
