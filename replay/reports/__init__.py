"""Reports of a run for people: findings, plots, the HTML page."""
