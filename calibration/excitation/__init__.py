"""What is played: sweeps, sequential and staggered base signals."""
