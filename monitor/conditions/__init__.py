"""What a flight shows that is no fault: a load that was dropped, the wind, a drift of the air pressure."""
