"""At the terminal: the live table of `fauio alarms`, what operators ask of a monitor, shell completion."""
