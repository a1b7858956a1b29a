"""Responses measured elsewhere become a bank: places in a plane, causal Green's functions, a report."""
