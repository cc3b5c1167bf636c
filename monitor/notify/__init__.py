"""Alarms to people: messages, their own programs, the ground station."""
