"""The Campaign tab: start, watch, interrupt and correct a campaign."""
