"""Recordings in, whole or damaged, and message logs out."""
