"""Stand-ins for a rig, all before one plate.

=========================  ==================================================================
`plates`                   `Plate`, `making.make_plate`: responses from actuators to positions, by name
`virtual.rig`              `VirtualRig`: a rig without wires, much faster than real time
`wire.emulated_rig`        `EmulatedRig`: emulated devices behind real drivers
=========================  ==================================================================
"""
