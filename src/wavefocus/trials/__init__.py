"""Perception trials: stimuli and their order, the session with a participant, the answers and their statistics."""
