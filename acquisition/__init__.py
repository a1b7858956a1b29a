"""The campaign: plan, schedule, engine, events, point quality; and a rig examined, calibrated and operated by hand.

=========================  ==================================================================
`schedule.plan`            `Plan`: everything a campaign does, as data
`schedule.grid`            `surface_grid`, `read_positions_file`
`schedule.trial`           `run_trial`: which schedule suits the plate
`measuring.setup`          `Setup`: open instruments and what is known of their wires
`engine.campaign`          `Campaign`: carries a plan out into a bank
`engine.session`           `Session`, `StopRequest`: state, requests and events of a run
`quality.limits`           `QualityLimits`, `DriftLimits`
`doctor.examination`       `examine`
`calibrate.mirror`         `measure_mirror`; `calibrate.channels` has `measure_inputs`, `measure_outputs`
`manual`                   `ManualMeasurements`: levels and single sweeps
=========================  ==================================================================
"""
