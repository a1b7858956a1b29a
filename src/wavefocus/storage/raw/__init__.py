"""Raw recordings: `open_raw` (reading), `create_raw` and `RawWriter` (writer), `RawHeader` (header), `Schedule`."""
