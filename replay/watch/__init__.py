"""``fauio watch``: a folder that logs come into."""
