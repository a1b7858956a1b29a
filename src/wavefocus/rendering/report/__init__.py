"""Pages, pictures and movies; matplotlib is loaded when a picture is made.

Public: `page` (build_report), `movie` (write_movie, snapshots), `movie_frames` (plan_frames), `scene_picture`
(scene_picture), `figures` (drift_over_time), `canvas` (Canvas, Picture, Surface) and `render_report` (RenderReport).
"""
