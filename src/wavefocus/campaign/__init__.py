"""A campaign from the command line: plan, sidecar files, log, view."""
