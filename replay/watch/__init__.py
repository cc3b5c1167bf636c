"""``fauio watch``: a folder into which logs are copied."""
