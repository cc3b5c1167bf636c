"""Rovers."""
