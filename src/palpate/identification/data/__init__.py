"""Recordings as identification takes them: windows, and pieces with known starts."""
