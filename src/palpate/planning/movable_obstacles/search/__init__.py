"""Which object to move where, so that a way opens: search, and the plans it hands out."""
