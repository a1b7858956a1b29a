"""Banks: `open_bank` (reading), `create_bank` and `BankWriter` (writer), `BankHeader`, `PointRecord` (ledger)."""
