"""The size of faults that a profile detects, and the delay."""
