"""The daemon's configuration: its keys, its checks with line numbers, its reference page."""
