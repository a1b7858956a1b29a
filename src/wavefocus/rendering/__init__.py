"""Scenes into drives, drives into fields, fields against scans.

=========================  ==================================================================
`scene.model`              `Scene`, `Source`, `load_scene`; paths and signals next to it
`greens.source`            `GreenSource`, `GreenArray`: the bank as the renderer reads it
`greens.interpolation`     the bank between its positions
`drive.rendering`          `SceneRenderer`, `render_with_report`: a scene into the drives of all actuators
`live.engine`              `LiveEngine`: drives of sources whose positions arrive while they sound
`field.prediction`         `predict`, `Prediction`: drives into the field
`verify.scan`              `scan`: the field measured again
`verify.verdict`           `compare`, `Verification`
`report.page`              `build_report`
=========================  ==================================================================
"""
