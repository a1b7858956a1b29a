"""The window: it shows campaigns and gives orders, and never owns a run.

=========================  ==================================================================
`shell.front_door`         opens the window once it has found a display
`shell.window`             `Window`; `shell.tab` has `Tab`, `TabContext`
`shell.process`            `CommandProcess`: every command of the window
`surface.view`             `SurfaceView`: every picture of the surface
`campaign`, `rig`          tabs, each in its folder with `tab` as its first module
`scene`, `verification`    the same
=========================  ==================================================================

PyQt5 and pyqtgraph are imported in this package alone, and only by modules that `gui.shell.front_door` imports once it
has found a display.
"""
