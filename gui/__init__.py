"""The window: it shows campaigns and gives orders, and never owns a run.

PyQt5 and pyqtgraph are imported in this package alone, and only by modules that `gui.shell.front_door` imports once it
has found a display.
"""
