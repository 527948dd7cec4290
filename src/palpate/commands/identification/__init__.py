"""Parts of `palpate identify`: what it reads, and what it says of fits and of draws."""
