"""The tables of a trials file that its tests share: a stroke of 8 mm to the left, and one to the right."""

STROKES = """
[path.left]
kind = "line"
start_mm = [8, 0]
end_mm = [0, 0]

[path.right]
kind = "line"
start_mm = [0, 0]
end_mm = [8, 0]

[signal.burst]
kind = "sine"
frequency_hz = 200.0
duration_s = 0.02

[[stimuli]]
path = ["left", "right"]
signal = "burst"
speed_mm_s = 200
step_mm = 4
"""
