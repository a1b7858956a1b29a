"""The Campaign tab: start, watch, interrupt and mend a night's measurement."""
