"""The methods that compete: one module or folder each, registered in `registry`."""
