"""Recordings through the very same pipeline: fit a profile, replay a log, convert, demonstrate."""
