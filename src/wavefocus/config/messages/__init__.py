"""Messages between processes: typed, written and read as JSON lines."""
