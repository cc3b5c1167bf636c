"""What a log states, whoever wrote it."""
