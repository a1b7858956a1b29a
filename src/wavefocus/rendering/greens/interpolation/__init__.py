"""The bank between its grid positions: interpolation methods and their errors.

Public: `base` (scene_interpolation, interpolation_method, Interpolation, GridInterpolation, Nodes, OffGridError),
`position_grid` (PositionGrid) and `errors` (judged_errors). Methods are registered in
`wavefocus.config.scene`.
"""
