"""A rig operated by hand: the beam jogged, levels heard, single sweeps."""
