"""Kinds of vehicles, a folder each."""
