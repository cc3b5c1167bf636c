"""`fauio review`: what happened in a log, without a profile."""
