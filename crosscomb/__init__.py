"""Virtual sensor for the vehicle sideslip angle."""

__version__ = "0.1.0"
