"""The editor of scene, run and rig files: their text, and what it means beside it."""
