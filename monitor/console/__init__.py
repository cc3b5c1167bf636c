"""`fauio alarms`: the live table and what operators ask of a monitor."""
