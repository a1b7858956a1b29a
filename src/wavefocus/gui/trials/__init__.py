"""The window of perception trials: one participant's pages over ``wavefocus trials --lines`` in a child process."""
