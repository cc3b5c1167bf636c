"""Recordings, processed by the pipeline of the running monitor: fit a profile, replay a log, convert, demonstrate."""
