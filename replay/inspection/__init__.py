"""`fauio info`: the content of a profile, model, gains file or recording."""
