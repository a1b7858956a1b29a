"""Files: written so that a crash at any instant loses nothing that was acknowledged, read without trust."""

import os

# It overrides what the program asks HDF5 for when it opens a file, and must be gone before h5py is loaded:
# locks of HDF5 keep readers away from a bank that is being measured.
os.environ.pop("HDF5_USE_FILE_LOCKING", None)
