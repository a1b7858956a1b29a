"""The file of raw recordings: header, layout, ledger, writer, reader."""
