"""`fauio doctor` and `fauio --version`: what is installed and what would get in a monitor's way."""
