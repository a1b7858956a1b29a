"""The campaign: plan, engine, point quality; and a rig examined, calibrated and operated by hand.

=====================  ==================================================================
`plan`                 `Plan`: everything a campaign does, as data; `grid` has its positions
`setup`                `Openers`, `Setup`: instruments, how they are wired and calibrated; one record
`attempt`              records of a position, their estimate, attempts, commits
`engine.campaign`      `Campaign`: carries a plan out into a bank
`engine.session`       `Session`, `StopRequest`: state, requests and events of a run
`engine.station`       `Station`: measures positions; `compare_schedules`: one position by both schedules
`judgement`            point quality, and the names of what is wrong
`drift_watch`          the sentinel; `limits`: how far it drifted; `neighbour_watch`: positions against the others
`doctor`               `examine`
`calibrate_mirror`     `measure_mirror`; `calibrate_channels`: `measure_inputs`, `measure_outputs`
`manual`               `ManualMeasurements`: levels and single sweeps
=====================  ==================================================================
"""
