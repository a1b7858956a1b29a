"""Clocks: where a known signal lies in a recording, and resampling onto the clock that played it."""
