"""A run for people: findings, plots, the HTML page."""
