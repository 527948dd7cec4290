"""A tip and plates on springs, in MuJoCo."""
