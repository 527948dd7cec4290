"""Models to plans: what to do, computed while or before it is done."""
