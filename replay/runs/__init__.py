"""`fauio replay`: one log, many in parallel, one as if live."""
