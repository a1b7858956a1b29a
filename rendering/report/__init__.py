"""Pages, figures and movies."""
