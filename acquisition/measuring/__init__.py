"""Measuring one position: setup, records, estimate, attempts, recordings that are kept."""
