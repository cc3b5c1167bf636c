"""`fauio demo`: the whole path on an embedded default."""
