"""Offline synthesis: a plant model in, certified observer gains out."""
