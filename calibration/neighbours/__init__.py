"""Rows predicted from their neighbours, and judged by it."""
