"""Conditions of a flight that are no fault: a load that was dropped, the wind, a drift of the air pressure."""
