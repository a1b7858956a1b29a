"""How a rig is calibrated: procedures that know roles and a person, no device and no window."""
