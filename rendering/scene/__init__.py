"""What is to be felt: sources, paths, signals, sampling."""
