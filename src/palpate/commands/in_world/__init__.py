"""Training and trying policies in worlds: what `palpate train` and `evaluate` do there."""
