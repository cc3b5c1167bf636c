"""What can be estimated with which sensors, and the bounds that no observer beats."""
