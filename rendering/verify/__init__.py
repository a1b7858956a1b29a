"""Fields against scans."""
