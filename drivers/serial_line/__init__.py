"""Serial lines: `ports` by name, a `line` with deadlines, a `dialogue` of questions and answers."""
