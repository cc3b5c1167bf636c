"""Multirotors."""
