"""Faults and attacks of exact truth, put into recordings."""
