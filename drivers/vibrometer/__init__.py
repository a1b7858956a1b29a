"""The laser vibrometer's controller, where it can be asked for its settings."""
