"""The window: it shows campaigns and gives orders, and never owns a run.

=========================  ==================================================================
`window`                   `Window`; `tab` has `Tab`, `TabContext`
`process`                  `CommandProcess`: every command of the window
`surface_view`             `SurfaceView`: every picture of the surface
`campaign`, `rig`          tabs, each in its folder with `tab` as its first module
`scene`, `verification`    the same
`trials`                   the window of perception trials, with `window` as its first module
=========================  ==================================================================

PyQt5 and pyqtgraph are imported in this package alone, and only by modules that `wavefocus.commands.gui` imports
once it has found a display.
"""
