"""Which positions are measured, and with which schedule."""
