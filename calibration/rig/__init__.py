"""Mirror map, delays, levels and polarities of a rig."""
