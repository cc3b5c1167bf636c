"""From evidence to alarms, and what operators do with them."""
