"""Pages, pictures and movies; matplotlib is loaded when a picture is made.

Public: `page` (build_report), `movie` (write_movie, snapshots, plan_frames), `figures` (drift_over_time), `canvas`
(Canvas, Picture, ReportSurface) and `render_report` (RenderReport).
"""
