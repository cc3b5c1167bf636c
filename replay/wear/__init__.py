"""`fauio trend`: wear across flights."""
