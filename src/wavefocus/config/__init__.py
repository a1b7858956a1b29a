"""Configuration: the schemas of rig, run and scene files, calibration records and messages; one-line mistakes.

=========================  ==================================================================
`rig`, `run`, `scene`      `RigConfig`, `RunConfig`, `SceneConfig` and their tables, pydantic models
`calibration`              `CalibrationRecord`, `load_calibration`
`outline`, `plate`         `Outline` of the surface; `PlateKeys` of a simulated plate
`loading`                  `read_toml`, `parse_toml`, `validated`
`interpolations`           methods that `[output] interpolation` may name
`messages`                 events, orders and answers between processes, with one codec
=========================  ==================================================================
"""
