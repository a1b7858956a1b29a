"""The drawing of a scene on the surface."""
