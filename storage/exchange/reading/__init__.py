"""Files of other formats, read for import: `opening` recognises and opens them, a module reads each format."""
