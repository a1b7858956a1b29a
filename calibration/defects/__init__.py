"""What is wrong with a record, in figures."""
