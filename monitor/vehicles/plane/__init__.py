"""Planes."""
