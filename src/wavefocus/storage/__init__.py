"""Files: written so that a crash at any instant loses nothing that was acknowledged, read without trust.

============================  ==========================================================================
`bank.reading`                `Bank`, `open_bank`: banks of this program; `bank.foreign` those of others
`bank.writer`, `bank.layout`  `create_bank`, `BankWriter`, `BankHeader`; `bank.ledger` has `PointRecord`
`raw.writer`, `raw.header`    `open_raw`, `RawFile`, `create_raw`, `RawWriter`; `RawHeader`
`drive_file`, `field_file`    `Drive`, `read_drive`, `write_drive`; `Field`, `FieldRowReader`, ...
`output_files`                `replacement`, `require_outputs`: results appear whole, and replace nothing
`exchange`                    banks in the formats of other fields
`ledger`                      what bank and raw files have in common
============================  ==========================================================================

Modules are imported by name: h5py comes with most of them, and a command that needs none does not load it.
"""

import os

# It overrides what the program asks HDF5 for when it opens a file, and must be gone before h5py is loaded:
# locks of HDF5 keep readers away from a bank that is being measured.
os.environ.pop("HDF5_USE_FILE_LOCKING", None)
