"""Scenes: sources that emit signals along paths, and their sampling.

Public: `model` (Scene, Source, load_scene, read_scene), `paths` and `svg` (Point, Line, Circle, Polyline, TextPath,
SvgPath), `trajectory_path` (TrajectoryPath), `signals` (Impulse, Sine, Noise, SoundFile), `sampling` (sample_scene),
`scene_rows` (scene_rows) and `size` (scene_size). Modules are imported one by one: a command loads what it uses.
"""
