"""The bank between its grid positions: interpolation methods, their errors, and the grid that a band needs.

Public: `base` (scene_interpolation, interpolation_method, Interpolation, GridInterpolation, Nodes, OffGridError),
`position_grid` (PositionGrid), `errors` (judged_errors) and `needed_grid`
(needed_grid, expected_error). Methods are registered in `wavefocus.config.interpolations`.
"""
