"""The bank file: header, layout, ledger, owner, writer, readers."""
