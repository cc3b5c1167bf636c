"""Faults and attacks, put into recordings with their exact truth."""
