"""Configuration: what rig, run and scene files may say, and one-line errors about what they must not."""
