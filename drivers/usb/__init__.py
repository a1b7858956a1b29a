"""USB: what is plugged in, whether it is what the rig expects, and a reset as a person's explicit choice."""
