"""From what sensors show to states and structure."""
