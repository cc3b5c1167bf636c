"""`fauio demo`: the whole path with a built-in example."""
