"""`fauio info`: what is in a profile, model, gains file or recording."""
