"""Healthy logs to a profile: identified models, designed gains, calibrated thresholds."""
