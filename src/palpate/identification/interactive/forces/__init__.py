"""What a hand felt: the masses of a twin's parts, and what resists at their joints."""
