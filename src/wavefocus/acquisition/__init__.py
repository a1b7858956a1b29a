"""The campaign: plan, engine, point quality; and a rig examined, calibrated and operated by hand.

=====================  ==================================================================
`plan`                 `Plan`: everything a campaign does, as data; `grid` has its positions
`trial`                `compare_schedules`: one position measured by both schedules
`setup`                `Openers`, `Setup`: instruments, how they are wired and calibrated; one record
`plays`, `attempt`     records of a position, their estimate, attempts, commits
`engine.campaign`      `Campaign`: carries a plan out into a bank
`engine.session`       `Session`, `StopRequest`: state, requests and events of a run
`judgement`, `limits`  point quality; `defects` names what is wrong
`drift_watch`          the sentinel; `neighbour_watch`: positions against their neighbours
`doctor`               `examine`
`calibrate_mirror`     `measure_mirror`; `calibrate_channels`: `measure_inputs`, `measure_outputs`
`manual`               `ManualMeasurements`: levels and single sweeps
=====================  ==================================================================
"""
