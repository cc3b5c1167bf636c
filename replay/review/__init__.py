"""`fauio review`: find out what happened in a log, without a profile."""
