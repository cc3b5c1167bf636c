"""What size of fault is seen how fast."""
