"""Scenes into drives, drives into fields, fields against scans."""
