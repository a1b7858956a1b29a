"""USB: `devices` that are plugged in, `matching` with what a rig expects, `reset` at a person's request."""
