"""The datasets of demonstrations: each comes from its own package or download."""
