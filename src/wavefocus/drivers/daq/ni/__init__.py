"""The driver ``nidaqmx``: National Instruments' devices, here or behind a gRPC Device Server."""
