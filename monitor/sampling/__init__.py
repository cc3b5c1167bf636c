"""From messages of different rates to samples on one grid, and when they count as evidence."""
