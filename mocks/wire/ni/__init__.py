"""An emulated NI box behind its gRPC server."""
