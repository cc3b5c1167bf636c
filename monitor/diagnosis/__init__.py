"""`fauio doctor` and `fauio --version`: the installed versions, and obstacles to a monitor on this machine."""
