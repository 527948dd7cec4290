"""Controllers of MuJoCo ropes."""
