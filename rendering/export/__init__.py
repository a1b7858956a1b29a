"""Banks in the formats of other fields: acoustics, modal analysis, sound, numerical tools."""
