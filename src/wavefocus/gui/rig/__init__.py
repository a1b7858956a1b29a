"""The Rig tab: examine a rig, operate it by hand, calibrate it; each in a command's process of its own."""
