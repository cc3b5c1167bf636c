"""The operator's side: the live table of `fauio alarms`, the web console, commands to a monitor, shell completion."""
