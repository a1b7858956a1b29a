"""Serial lines: ports by name, lines with deadlines, questions and their answers."""
