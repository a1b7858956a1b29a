"""From recordings to Green's functions.

=========================  ==================================================================
`excitation.sweeps`        `Excitation`, `StaggeredSignal`: what plays
`clock.timing`             `ClockFitter`, `to_playback_clock`: start offset and clock ratio
`estimator.sequential`     `SequentialEstimator`; `estimator.staggered` has `StaggeredEstimator`
`estimator.raw_estimation` `estimate_positions`: kept recordings of any program into responses
`defects.defect_finder`    `DefectFinder`: what a fit leaves unexplained
`neighbours.judge`         `NeighbourJudge`: a position against its neighbours
`rig.mirror_map`           `MirrorMap`, `fit_mirror_map`
`check`                    `check_bank`
=========================  ==================================================================
"""
