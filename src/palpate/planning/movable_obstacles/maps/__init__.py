"""Maps to plan on: what stands where, and how files of several kinds say it."""
