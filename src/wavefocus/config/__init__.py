"""Configuration: the schemas of rig, run and scene files, calibration records and messages; one-line mistakes.

=========================  ==================================================================
`rig`, `run`, `scene`      `RigConfig`, `RunConfig`, `SceneConfig` and their tables, pydantic models; `INTERPOLATIONS`
`calibration`              `CalibrationRecord`, `load_calibration`
`outline`, `emulation`     `Outline` of the surface; `PlateKeys` of a simulated plate
`loading`                  `read_toml`, `parse_toml`, `validated`
`messages`                 events, orders and answers between processes, with one codec
=========================  ==================================================================
"""
