"""The Verification tab: run one, or look at an earlier one."""
