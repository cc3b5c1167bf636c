"""Alarms to people: messages, programs of theirs, the ground station."""
