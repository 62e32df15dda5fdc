"""What crosses the package's border: units, files and headers."""
