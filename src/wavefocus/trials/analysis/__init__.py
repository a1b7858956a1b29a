"""Statistics of answers: accuracy, sensitivity, psychometric functions, reaction times, and a report."""
