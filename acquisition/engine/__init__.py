"""The campaign engine: attempts, records, recovery, suspension, events."""
