"""The surface view that all tabs share: surfaces, maps, colour bars, the time slider and plots."""
