"""Which parts of the small model earn their keep; the program is `__main__`."""
