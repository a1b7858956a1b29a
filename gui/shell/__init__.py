"""The window itself: tabs, actions, theme, messages, files."""
