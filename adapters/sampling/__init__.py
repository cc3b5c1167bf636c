"""Messages to (u, y) samples on a fixed-rate grid, one by one or a block at once."""
