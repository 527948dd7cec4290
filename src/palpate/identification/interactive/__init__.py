"""From handling to a twin: which parts there are, on which joints, and how they move."""
