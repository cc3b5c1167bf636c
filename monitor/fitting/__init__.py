"""Healthy logs to a profile: identified, designed, thresholds for a stated rate of false alarms."""
