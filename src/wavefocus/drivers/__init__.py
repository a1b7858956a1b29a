"""Instruments: the protocols of the roles and the drivers that implement them.

=========================  ==================================================================
`protocols`                `Mirror`, `Recorder`, `Player`, `RecordRequest`, `Recording`
`errors`                   `InstrumentError`, `TransientInstrumentError`, `InstrumentLostError`
`registry`                 `Registry`, `rig_key`: drivers by name; a new one is a module in its role's folder
`process`                  `DriverProcess`: a driver in a process of its own
`timeouts`                 `BoundedMirror`, `BoundedRecorder`, `BoundedPlayer`: calls with a time limit
=========================  ==================================================================
"""
