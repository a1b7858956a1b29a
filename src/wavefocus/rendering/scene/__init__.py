"""Scenes: sources that emit signals along paths, and their sampling.

Public: `model` (Scene, Source, load_scene, read_scene), `paths` and `svg` (Point, Line, Circle, Polyline, TextPath,
SvgPath), `trajectory` (TrajectoryPath), `signals` (Impulse, Sine, Noise, SoundFile), `sampling` (sample_scene,
scene_size) and `scene_rows` (scene_rows). Modules are imported one by one: a command loads what it uses.
"""
