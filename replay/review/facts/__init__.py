"""The facts that a log states, for every kind of log."""
